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


@njit(inline="always")
def append(
    samples: Samples, row: int, y: tuple[float, float, float], u: tuple[float, float, float], t: float, dt: float,
    ray: int, previous: int,
) -> None:  # fmt: skip
    """Fill a row of the samples."""
    samples.y[row, 0], samples.y[row, 1], samples.y[row, 2] = y
    samples.u[0, row], samples.u[1, row], samples.u[2, row] = u
    samples.t[row], samples.dt[row] = t, dt
    samples.ray[row], samples.previous[row] = ray, previous


@inner
def advance(dom: Domain, count: int, per_ray: int, row: int, rays: Rays, samples: Samples) -> int:
    """Append up to `per_ray` occupied samples of each living ray, one at least, after `row`; return the new end.

    Samples of a ray lie on t0 + i * step whatever was skipped, so that every way to skip gives the same samples.
    """
    if dom.contracted:
        return advance_contracted(dom, count, per_ray, row, rays, samples)
    return advance_in_box(dom, count, per_ray, row, rays, samples)


@inner
def advance_in_box(dom: Domain, count: int, per_ray: int, row: int, rays: Rays, samples: Samples) -> int:
    """`advance` in uncontracted space: all rays leap to where they meet an occupied cell, then each looks ahead."""
    n, m = np.float32(dom.resolution), np.float32(dom.resolution // BLOCK)
    step, half = np.float32(dom.step), np.float32(0.5)
    bits, lines, capacity = dom.bits, rays.lines, samples.t.shape[0]
    for r in range(0, count, ABREAST):
        leap(bits, dom.distance, n, m, step, lines, rays.t, rays.far, rays.alive, r)
    for r in range(count):
        if not rays.alive[r]:
            continue
        o0, o1, o2, d0, d1, d2 = lines[0, r], lines[1, r], lines[2, r], lines[3, r], lines[4, r], lines[5, r]
        t, far, last = rays.t[r], rays.far[r], rays.last[r]
        end = min(row + per_ray, capacity)
        if t < far and row < end:
            u0, u1, u2, _ = to_cube(False, o0 + t * d0, o1 + t * d1, o2 + t * d2)
            # Here it is occupied, whatever this finds of a place that rounding has put on the border of two cells.
            found = 1 | occupied_ahead(bits, n, u0, u1, u2, half * step * d0, half * step * d1, half * step * d2)
            begun, t = t, t + step * np.float32(AHEAD)
            while found != 0:
                at = begun + step * np.float32(lowest_bit(found))
                found &= found - 1
                if at >= far:
                    break
                y = o0 + at * d0, o1 + at * d1, o2 + at * d2
                u0, u1, u2, _ = to_cube(False, y[0], y[1], y[2])
                append(samples, row, y, (u0, u1, u2), at, step, r, last)
                last = row
                row += 1
                if row >= end:
                    t = at + step
                    break
        rays.t[r], rays.last[r] = t, last
        if t >= far:
            rays.alive[r] = False
    return row


@inner
def advance_contracted(dom: Domain, count: int, per_ray: int, row: int, rays: Rays, samples: Samples) -> int:
    """`advance` in contracted space, where steps grow with distance."""
    m, step = np.float32(dom.resolution // BLOCK), np.float32(dom.step)
    lines, capacity = rays.lines, samples.t.shape[0]
    for r in range(count):
        if not rays.alive[r]:
            continue
        o0, o1, o2, d0, d1, d2 = lines[0, r], lines[1, r], lines[2, r], lines[3, r], lines[4, r], lines[5, r]
        t, far, last = rays.t[r], rays.far[r], rays.last[r]
        end = min(row + per_ray, capacity)
        while row < end and t < far:
            y = o0 + t * d0, o1 + t * d1, o2 + t * d2
            u0, u1, u2, grow = to_cube(True, y[0], y[1], y[2])
            dt = step * grow
            empty = occupied(dom, u0, u1, u2)
            if empty < 0:
                append(samples, row, y, (u0, u1, u2), t, dt, r, last)
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
