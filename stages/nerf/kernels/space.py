"""Normalised space and the unit cube of the grids: contraction (Barron et al., 2022) and occupancy bits."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from fieldpose.stages.nerf.kernels.inner import inner
from fieldpose.stages.nerf.kernels.types import BLOCK, Domain


@njit(inline="always")
def to_cube(contracted: bool, y0: float, y1: float, y2: float) -> tuple[float, float, float, float]:
    """Position in the unit cube of the grid, and the distance from the centre that the step grows with."""
    if not contracted:
        return (
            (y0 + np.float32(1)) * np.float32(0.5),
            (y1 + np.float32(1)) * np.float32(0.5),
            (y2 + np.float32(1)) * np.float32(0.5),
            np.float32(1),
        )
    r = math.sqrt(y0 * y0 + y1 * y1 + y2 * y2)
    scale = np.float32(0.25)
    if r > np.float32(1):
        scale *= (np.float32(2) - np.float32(1) / r) / r
    half = np.float32(0.5)
    return y0 * scale + half, y1 * scale + half, y2 * scale + half, max(r, np.float32(1))


@inner
def cube_gradient(contracted: bool, y: np.ndarray, du: np.ndarray, dy: np.ndarray) -> None:
    """Pull the gradient du (3,) with respect to the cube back to normalised coordinates, into dy (3,)."""
    if not contracted:
        for a in range(3):
            dy[a] = du[a] * np.float32(0.5)
        return
    r = math.sqrt(y[0] * y[0] + y[1] * y[1] + y[2] * y[2])
    quarter = np.float32(0.25)
    if r <= np.float32(1):
        for a in range(3):
            dy[a] = du[a] * quarter
        return
    inverse = np.float32(1) / r
    scale = (np.float32(2) - inverse) * inverse
    slope = (np.float32(2) * inverse - np.float32(2)) * inverse * inverse  # d scale / d r
    dot = (du[0] * y[0] + du[1] * y[1] + du[2] * y[2]) * slope * inverse
    for a in range(3):
        dy[a] = quarter * (scale * du[a] + dot * y[a])


@njit(inline="always")
def occupied(dom: Domain, u0: float, u1: float, u2: float) -> int:
    """-1 where the cell is occupied, else how many blocks away the nearest block with an occupied cell is."""
    n = np.int32(dom.resolution)
    ix = min(max(np.int32(u0 * n), np.int32(0)), n - np.int32(1))
    iy = min(max(np.int32(u1 * n), np.int32(0)), n - np.int32(1))
    iz = min(max(np.int32(u2 * n), np.int32(0)), n - np.int32(1))
    m = n // BLOCK
    distance = dom.distance[np.uint64((ix // BLOCK) + m * ((iy // BLOCK) + m * (iz // BLOCK)))]
    if distance > 0:
        return np.int64(distance)
    flat = np.uint64(ix + n * (iy + n * iz))
    return -1 if (dom.bits[flat >> np.uint64(3)] >> (flat & np.uint64(7))) & 1 else 0


@njit(inline="always")
def clip(dom: Domain, o: np.ndarray, d: np.ndarray) -> tuple[float, float]:
    """Where a ray with unit direction enters and leaves the domain; empty where the second is not larger."""
    near, far = np.float32(dom.near), np.float32(dom.far)
    if dom.boxed:
        for a in range(3):
            if abs(d[a]) < np.float32(1e-9):
                if o[a] < dom.low[a] or o[a] > dom.high[a]:
                    far = near
            else:
                inverse = np.float32(1) / d[a]
                t0 = (dom.low[a] - o[a]) * inverse
                t1 = (dom.high[a] - o[a]) * inverse
                near = max(near, min(t0, t1))
                far = min(far, max(t0, t1))
    return near, far
