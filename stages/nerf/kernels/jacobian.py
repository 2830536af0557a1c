"""Colour and its derivative with respect to the ray, for the refinement of poses."""

from __future__ import annotations

import numpy as np

from fieldpose.stages.fastmath import FASTMATH
from fieldpose.stages.kernel_cache import cached_njit
from fieldpose.stages.nerf.kernels.backward import (
    colour_backward,
    compact,
    composite_backward,
    density_backward,
    shade_backward,
)
from fieldpose.stages.nerf.kernels.encoding import position_gradients
from fieldpose.stages.nerf.kernels.inner import inner
from fieldpose.stages.nerf.kernels.packet import forward, shade, surface
from fieldpose.stages.nerf.kernels.space import cube_gradient
from fieldpose.stages.nerf.kernels.types import SH_SIZE, Domain, Net, Rays, Samples


@inner
def harmonics_gradient(d: np.ndarray, g: np.ndarray, at: int, out: np.ndarray) -> None:
    """Add to out (3,) the gradient with respect to the unit direction of the harmonics with gradient g[at:at + 16]."""
    x, y, z = d[0], d[1], d[2]
    xx, yy, zz = x * x, y * y, z * z
    out[0] += (
        -0.48860251 * g[at + 3] + 1.09254843 * (y * g[at + 4] - z * g[at + 7] + x * g[at + 8])
        - 3.54026154 * x * y * g[at + 9] + 2.89061144 * y * z * g[at + 10]
        + 0.45704580 * (1 - 5 * zz) * g[at + 13] + 2.89061144 * z * x * g[at + 14]
        + 1.77013077 * (yy - xx) * g[at + 15]
    )  # fmt: skip
    out[1] += (
        -0.48860251 * g[at + 1] + 1.09254843 * (x * g[at + 4] - z * g[at + 5] - y * g[at + 8])
        + 1.77013077 * (yy - xx) * g[at + 9] + 2.89061144 * x * z * g[at + 10]
        + 0.45704580 * (1 - 5 * zz) * g[at + 11] - 2.89061144 * z * y * g[at + 14]
        + 3.54026154 * x * y * g[at + 15]
    )  # fmt: skip
    out[2] += (
        0.48860251 * g[at + 2] - 1.09254843 * (y * g[at + 5] + x * g[at + 7]) + 1.89234942 * z * g[at + 6]
        + 2.89061144 * x * y * g[at + 10] - 4.57045800 * z * (y * g[at + 11] + x * g[at + 13])
        + 0.37317633 * (15 * zz - 3) * g[at + 12] + 1.44530572 * (xx - yy) * g[at + 14]
    )  # fmt: skip


@inner
def ray_gradients(
    net: Net,
    contracted: bool,
    directions: np.ndarray,
    start: int,
    count: int,
    rows: int,
    samples: Samples,
    rays: Rays,
    du: np.ndarray,
    dy: np.ndarray,
    jacobian: np.ndarray,
    k: int,
) -> None:
    """Add up the samples' gradients into jacobian[start:start + count, k]: origin, then unit direction.

    du (3, rows) and dy (3,) are scratch.
    """
    features = rays.feats.shape[1] - SH_SIZE
    for r in range(count):
        harmonics_gradient(directions[start + r], rays.dfeats[r], features, jacobian[start + r, k, 3:])
    position_gradients(net, samples, np.int64(0), rows, du)
    for s in range(rows):
        cube_gradient(contracted, samples.y[s], du[:, s], dy)
        r = start + samples.ray[s]
        for a in range(3):
            jacobian[r, k, a] += dy[a]
            jacobian[r, k, 3 + a] += dy[a] * samples.t[s]


@cached_njit(nogil=True, fastmath=FASTMATH)
def render_jacobian(
    net: Net,
    dom: Domain,
    origins: np.ndarray,
    directions: np.ndarray,
    jitter: np.ndarray,
    background: np.ndarray,
    channel_weights: np.ndarray,
    first: int,
    last: int,
    per_ray: int,
    stop_below: float,
    samples: Samples,
    rays: Rays,
    rgb: np.ndarray,
    depth: np.ndarray,
    opacity: np.ndarray,
    jacobian: np.ndarray,
) -> None:
    """Render, and fill jacobian (n, k, 6): channel_weights (k, 3) @ rgb by origin and unit direction.

    Where the samples lie along the ray is held fixed.
    """
    size = rays.opacity.shape[0]
    drgb = np.empty((size, 3), np.float32)
    du, dy = np.empty((3, samples.t.shape[0]), np.float32), np.empty(3, np.float32)
    for start in range(first, last, size):
        count = min(size, last - start)
        rows, _ = forward(
            net, dom, origins, directions, jitter, start, count, per_ray, stop_below, np.bool_(True), samples, rays
        )
        rows = compact(samples, rays, rows)
        for r in range(count):
            for c in range(3):
                rgb[start + r, c] = shade(rays, r, c, background[c])
            opacity[start + r] = rays.opacity[r]
            depth[start + r] = surface(rays, r)
        for k in range(channel_weights.shape[0]):
            for r in range(count):
                for c in range(3):
                    drgb[r, c] = channel_weights[k, c]
                shade_backward(rays, r, background, drgb[r])
            colour_backward(net, rays, count, drgb)
            composite_backward(samples, rays, count, 0.0, dom.contracted)
            if rows > 0:
                density_backward(net, samples, rows)
            ray_gradients(net, dom.contracted, directions, start, count, rows, samples, rays, du, dy, jacobian, k)
