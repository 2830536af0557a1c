"""One training step's share of a thread: forward, loss, backward, gradients."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from fieldpose.stages.fastmath import FASTMATH
from fieldpose.stages.kernel_cache import cached_njit
from fieldpose.stages.nerf.kernels.backward import (
    colour_backward,
    compact,
    composite_backward,
    density_backward,
    shade_backward,
)
from fieldpose.stages.nerf.kernels.encoding import scatter
from fieldpose.stages.nerf.kernels.packet import forward, shade
from fieldpose.stages.nerf.kernels.types import Domain, Net, Rays, Samples


class Gradients(NamedTuple):
    """A thread's gradients, of the shapes of the parameters."""

    table: np.ndarray
    w1: np.ndarray
    w2: np.ndarray
    c1: np.ndarray
    c2: np.ndarray
    c3: np.ndarray


@njit(nogil=True, fastmath=FASTMATH)
def accumulate(net: Net, samples: Samples, rays: Rays, rows: int, count: int, grads: Gradients) -> None:
    """Add a packet's gradients to `grads`."""
    grads.c3[:] += np.dot(rays.h2[:count].T, rays.drgb[:count])
    grads.c2[:] += np.dot(rays.h1[:count].T, rays.dh2[:count])
    grads.c1[:] += np.dot(rays.feats[:count].T, rays.dh1[:count])
    if rows > 0:
        grads.w2[:] += np.dot(samples.h[:rows].T, samples.dout[:rows])
        grads.w1[:] += np.dot(samples.x[:rows].T, samples.dh[:rows])
        scatter(net, samples, np.int64(0), rows, grads.table)


@cached_njit(nogil=True, fastmath=FASTMATH)
def train(
    net: Net,
    dom: Domain,
    origins: np.ndarray,
    directions: np.ndarray,
    jitter: np.ndarray,
    background: np.ndarray,
    target: np.ndarray,
    first: int,
    last: int,
    packet: int,
    per_ray: int,
    stop_below: float,
    huber_delta: float,
    distortion: float,
    scale: float,
    samples: Samples,
    rays: Rays,
    grads: Gradients,
    errors: np.ndarray,
    depths: np.ndarray,
) -> int:
    """Add the gradients of rays first..last, fill their squared errors and depths; return the samples evaluated.

    `packet` rays are traced together, at most as many as `rays` has room for. The loss is Huber's of the colour
    against `target` (n, 3), already over the ray's `background` (n, 3), times `scale`, plus the distortion loss.
    """
    size = min(packet, rays.opacity.shape[0])
    drgb = np.empty((size, 3), np.float32)
    total = 0
    for start in range(first, last, size):
        count = min(size, last - start)
        rows, evaluated = forward(
            net, dom, origins, directions, jitter, start, count, per_ray, stop_below, np.bool_(True), samples, rays
        )
        total += evaluated
        rows = compact(samples, rays, rows)
        for r in range(count):
            squared = np.float32(0)
            for c in range(3):
                error = shade(rays, r, c, background[start + r, c]) - target[start + r, c]
                squared += error * error
                drgb[r, c] = scale * max(-huber_delta, min(huber_delta, error))
            errors[start + r], depths[start + r] = squared, rays.median[r]
            shade_backward(rays, r, background[start + r], drgb[r])
        colour_backward(net, rays, count, drgb)
        composite_backward(samples, rays, count, distortion * scale, dom.contracted)
        if rows > 0:
            density_backward(net, samples, rows)
        accumulate(net, samples, rays, rows, count, grads)
    return total
