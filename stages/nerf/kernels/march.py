"""Advance a packet of rays through the occupied cells, a few samples a ray at a time."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from fieldpose.stages.nerf.kernels.ahead import ABREAST, AHEAD, leap, occupied_ahead
from fieldpose.stages.nerf.kernels.inner import inner
from fieldpose.stages.nerf.kernels.space import clip, occupied, to_cube
from fieldpose.stages.nerf.kernels.types import BLOCK, Domain, Rays, Samples
from fieldpose.stages.nerf.kernels.vectors import lowest_bit

TINY, HUGE = np.float32(1e-9), np.float32(1e9)


@njit(inline="always")
def inverse(component: float) -> float:
    """1 / component, large where the ray does not move along the axis."""
    return np.float32(1) / component if abs(component) > TINY else HUGE


@inner
def begin(
    dom: Domain, origins: np.ndarray, directions: np.ndarray, jitter: np.ndarray, first: int, count: int, rays: Rays
) -> None:
    """Put rays first..first+count at the start of their way; the packet's arrays are cleared."""
    m = np.float32(dom.resolution // BLOCK)
    rays.alive[count:] = False
    for r in range(count):
        o, d = origins[first + r], directions[first + r]
        for a in range(3):
            rays.lines[a, r], rays.lines[3 + a, r], rays.lines[6 + a, r] = o[a], d[a], inverse(d[a]) / m
        near, far = clip(dom, o, d)
        rays.t[r] = near + jitter[first + r] * dom.step
        rays.far[r] = far
        rays.trans[r] = 1
        rays.last[r] = -1
        rays.alive[r] = far > near
        rays.opacity[r] = 0
        rays.depth[r] = 0
        rays.median[r] = 0
        rays.sums[r, :] = 0


@inner
def advance(dom: Domain, count: int, per_ray: int, row: int, rays: Rays, samples: Samples) -> int:
    """Append up to `per_ray` occupied samples of each living ray after `row`; return the new end.

    Samples of a ray lie on t0 + i * step whatever was skipped, so that every way to skip gives the same samples.
    """
    n, m = np.float32(dom.resolution), np.float32(dom.resolution // BLOCK)
    step, half = np.float32(dom.step), np.float32(0.5)
    contracted, bits, distance, lines = dom.contracted, dom.bits, dom.distance, rays.lines
    capacity = samples.t.shape[0]
    if not contracted:
        for r in range(0, count, ABREAST):
            leap(bits, distance, n, m, step, lines, rays.t, rays.far, rays.alive, r)
    for r in range(count):
        if not rays.alive[r]:
            continue
        o0, o1, o2, d0, d1, d2 = lines[0, r], lines[1, r], lines[2, r], lines[3, r], lines[4, r], lines[5, r]
        t, far, last = rays.t[r], rays.far[r], rays.last[r]
        end = min(row + per_ray, capacity)
        if not contracted:
            if t < far and row < end:
                u0, u1, u2, _ = to_cube(False, o0 + t * d0, o1 + t * d1, o2 + t * d2)
                found = occupied_ahead(bits, n, u0, u1, u2, half * step * d0, half * step * d1, half * step * d2)
                begun, t = t, t + step * np.float32(AHEAD)
                while found != 0:
                    t_sample = begun + step * np.float32(lowest_bit(found))
                    found &= found - 1
                    if t_sample >= far:
                        break
                    y0, y1, y2 = o0 + t_sample * d0, o1 + t_sample * d1, o2 + t_sample * d2
                    samples.y[row, 0], samples.y[row, 1], samples.y[row, 2] = y0, y1, y2
                    u0, u1, u2, _ = to_cube(False, y0, y1, y2)
                    samples.u[0, row], samples.u[1, row], samples.u[2, row] = u0, u1, u2
                    samples.t[row], samples.dt[row] = t_sample, step
                    samples.ray[row], samples.previous[row] = r, last
                    last = row
                    row += 1
                    if row >= end:
                        t = t_sample + step
                        break
        else:
            while row < end and t < far:
                y0, y1, y2 = o0 + t * d0, o1 + t * d1, o2 + t * d2
                u0, u1, u2, grow = to_cube(True, y0, y1, y2)
                dt = step * grow
                empty = occupied(dom, u0, u1, u2)
                if empty < 0:
                    samples.y[row, 0], samples.y[row, 1], samples.y[row, 2] = y0, y1, y2
                    samples.u[0, row], samples.u[1, row], samples.u[2, row] = u0, u1, u2
                    samples.t[row], samples.dt[row] = t, dt
                    samples.ray[row], samples.previous[row] = r, last
                    last = row
                    row += 1
                    t += dt
                else:
                    # Along a ray of unit speed no coordinate of the cube changes faster than by 1/4.
                    free = t + np.float32(empty - 1) * np.float32(4) / m
                    t += dt
                    while t < free and t < far:
                        y0, y1, y2 = o0 + t * d0, o1 + t * d1, o2 + t * d2
                        t += step * max(np.float32(1), np.float32(math.sqrt(y0 * y0 + y1 * y1 + y2 * y2)))
        rays.t[r], rays.last[r] = t, last
        if t >= far:
            rays.alive[r] = False
    return row
