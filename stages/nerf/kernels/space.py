"""Normalised space and the unit cube of the grids: contraction (Barron et al., 2022) and occupancy bits."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from stages.nerf.kernels.types import FASTMATH, Domain


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


@njit(nogil=True, fastmath=FASTMATH)
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
    """0 where the block of the position is empty, 1 where only its cell is, 2 where the cell is occupied."""
    n = dom.resolution
    ix = min(max(int(u0 * n), 0), n - 1)
    iy = min(max(int(u1 * n), 0), n - 1)
    iz = min(max(int(u2 * n), 0), n - 1)
    m = n >> 3
    if dom.coarse[(ix >> 3) + m * ((iy >> 3) + m * (iz >> 3))] == 0:
        return 0
    flat = ix + n * (iy + n * iz)
    return 2 if (dom.bits[flat >> 3] >> (flat & 7)) & 1 else 1


@njit(inline="always")
def clip(dom: Domain, o: np.ndarray, d: np.ndarray) -> tuple[float, float]:
    """Where a ray with unit direction enters and leaves the domain; empty where the second is not larger."""
    near, far = np.float32(dom.near), np.float32(dom.far)
    if not dom.contracted:
        for a in range(3):
            if abs(d[a]) < np.float32(1e-9):
                if abs(o[a]) > dom.half[a]:
                    far = near
            else:
                inverse = np.float32(1) / d[a]
                t0 = (-dom.half[a] - o[a]) * inverse
                t1 = (dom.half[a] - o[a]) * inverse
                near = max(near, min(t0, t1))
                far = min(far, max(t0, t1))
    return near, far


@njit(inline="always")
def skip(n: int, u0: float, u1: float, u2: float, d: np.ndarray) -> float:
    """Distance to the border of the cell (of n along an axis) that the position lies in; uncontracted space."""
    best = np.float32(1e9)
    for a in range(3):
        u = u0 if a == 0 else (u1 if a == 1 else u2)
        if abs(d[a]) > np.float32(1e-9):
            index = math.floor(u * n)
            border = (index + 1 if d[a] > 0 else index) / n
            best = min(best, np.float32((border - u) * 2 / d[a]))
    return max(best, np.float32(0))
