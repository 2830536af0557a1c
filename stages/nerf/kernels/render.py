"""Render rays: colour, depth and opacity."""

from __future__ import annotations

import numpy as np
from numba import njit

from stages.fastmath import FASTMATH
from stages.nerf.kernels.march import begin
from stages.nerf.kernels.packet import shade, surface, trace
from stages.nerf.kernels.sight import narrow
from stages.nerf.kernels.types import Domain, Net, Rays, Samples


@njit(nogil=True, fastmath=FASTMATH, cache=True)
def render(
    net: Net,
    dom: Domain,
    origins: np.ndarray,
    directions: np.ndarray,
    jitter: np.ndarray,
    limits: np.ndarray,
    background: np.ndarray,
    first: int,
    last: int,
    per_ray: int,
    stop_below: float,
    samples: Samples,
    rays: Rays,
    rgb: np.ndarray,
    depth: np.ndarray,
    opacity: np.ndarray,
) -> int:
    """Fill rgb, depth (distance along the unit direction, 0 where nothing) and opacity; return the samples used.

    limits (n, 2): between which distances each ray is traced.
    """
    size = rays.t.shape[0]
    total = 0
    for start in range(first, last, size):
        count = min(size, last - start)
        begin(dom, origins, directions, jitter, start, count, rays)
        narrow(dom, limits, start, count, rays)
        _, evaluated = trace(
            net, dom, origins, directions, start, count, per_ray, stop_below, False, samples, rays
        )
        total += evaluated
        for r in range(count):
            for c in range(3):
                rgb[start + r, c] = shade(rays, r, c, background[c])
            opacity[start + r] = rays.opacity[r]
            depth[start + r] = surface(rays, r)
    return total
