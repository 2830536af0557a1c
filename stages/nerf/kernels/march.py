"""Advance a packet of rays through the occupied cells, a few samples a ray at a time."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from stages.nerf.kernels.space import clip, occupied, skip, to_cube
from stages.nerf.kernels.types import FASTMATH, Domain, Rays, Samples


@njit(nogil=True, fastmath=FASTMATH)
def begin(
    dom: Domain, origins: np.ndarray, directions: np.ndarray, jitter: np.ndarray, first: int, count: int, rays: Rays
) -> None:
    """Put rays first..first+count at the start of their way; the packet's arrays are cleared."""
    for r in range(count):
        o, d = origins[first + r], directions[first + r]
        near, far = clip(dom, o, d)
        rays.t[r] = near + jitter[first + r] * dom.step
        rays.far[r] = far
        rays.trans[r] = 1
        rays.last[r] = -1
        rays.alive[r] = far > near
        rays.opacity[r] = 0
        rays.depth[r] = 0
        rays.median[r] = 0
        rays.feats[r, :] = 0


@njit(nogil=True, fastmath=FASTMATH)
def advance(
    dom: Domain,
    origins: np.ndarray,
    directions: np.ndarray,
    first: int,
    count: int,
    per_ray: int,
    row: int,
    rays: Rays,
    samples: Samples,
) -> int:
    """Append up to `per_ray` occupied samples of each living ray after `row`; return the new end.

    Samples of a ray lie on t0 + i * step whatever was skipped, so that every way to skip gives the same samples.
    """
    n = dom.resolution
    capacity = samples.t.shape[0]
    for r in range(count):
        if not rays.alive[r]:
            continue
        o, d = origins[first + r], directions[first + r]
        t, far = rays.t[r], rays.far[r]
        taken = 0
        while taken < per_ray and t < far and row < capacity:
            y0, y1, y2 = o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]
            u0, u1, u2, grow = to_cube(dom.contracted, y0, y1, y2)
            dt = np.float32(dom.step) * grow
            state = occupied(dom, u0, u1, u2)
            if state == 2:
                samples.y[row, 0], samples.y[row, 1], samples.y[row, 2] = y0, y1, y2
                samples.u[row, 0], samples.u[row, 1], samples.u[row, 2] = u0, u1, u2
                samples.t[row], samples.dt[row] = t, dt
                samples.ray[row], samples.previous[row] = r, rays.last[r]
                rays.last[r] = row
                row += 1
                taken += 1
                t += dt
            elif dom.contracted:
                t += dt
            else:
                ahead = skip(n >> 3 if state == 0 else n, u0, u1, u2, d)
                t += dt * max(np.float32(1), np.float32(math.ceil(ahead / dt)))
        rays.t[r] = t
        if t >= far or taken < per_ray:
            rays.alive[r] = False
    return row
