"""Advance a packet of rays through the occupied cells, a few samples a ray at a time."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from fieldpose.stages.fastmath import FASTMATH
from fieldpose.stages.nerf.kernels.space import clip, occupied, skip, to_cube
from fieldpose.stages.nerf.kernels.types import BLOCK, Domain, Rays, Samples

TINY, HUGE = np.float32(1e-9), np.float32(1e9)


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


@njit(inline="always")
def inverse(component: float) -> float:
    """1 / component, large where the ray does not move along the axis."""
    return np.float32(1) / component if abs(component) > TINY else HUGE


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
    n, m = np.float32(dom.resolution), np.float32(dom.resolution // BLOCK)
    step = np.float32(dom.step)
    capacity = samples.t.shape[0]
    for r in range(count):
        if not rays.alive[r]:
            continue
        o0, o1, o2 = origins[first + r, 0], origins[first + r, 1], origins[first + r, 2]
        d0, d1, d2 = directions[first + r, 0], directions[first + r, 1], directions[first + r, 2]
        i0, i1, i2 = inverse(d0), inverse(d1), inverse(d2)
        t, far = rays.t[r], rays.far[r]
        taken = 0
        while taken < per_ray and t < far and row < capacity:
            y0, y1, y2 = o0 + t * d0, o1 + t * d1, o2 + t * d2
            u0, u1, u2, grow = to_cube(dom.contracted, y0, y1, y2)
            dt = step * grow
            empty = occupied(dom, u0, u1, u2)
            if empty < 0:
                samples.y[row, 0], samples.y[row, 1], samples.y[row, 2] = y0, y1, y2
                samples.u[0, row], samples.u[1, row], samples.u[2, row] = u0, u1, u2
                samples.t[row], samples.dt[row] = t, dt
                samples.ray[row], samples.previous[row] = r, rays.last[r]
                rays.last[r] = row
                row += 1
                taken += 1
                t += dt
            elif dom.contracted:
                # Along a ray of unit speed no coordinate of the cube changes faster than by 1/4.
                free = t + np.float32(empty - 1) * np.float32(4) / m
                t += dt
                while t < free and t < far:
                    y0, y1, y2 = o0 + t * d0, o1 + t * d1, o2 + t * d2
                    t += step * max(np.float32(1), np.float32(math.sqrt(y0 * y0 + y1 * y1 + y2 * y2)))
            else:
                if empty == 0:
                    ahead = skip(n, np.float32(0), u0, u1, u2, i0, i1, i2)
                else:
                    ahead = skip(m, np.float32(empty - 1), u0, u1, u2, i0, i1, i2)
                t += dt * max(np.float32(1), np.ceil(ahead / dt))
        rays.t[r] = t
        if t >= far or taken < per_ray:
            rays.alive[r] = False
    return row
