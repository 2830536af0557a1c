"""Where along the rays of a tile of a view anything can be, from what blocks of cells are occupied."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from fieldpose.stages.fastmath import FASTMATH
from fieldpose.stages.kernel_cache import cached_njit
from fieldpose.stages.nerf.kernels.inner import inner
from fieldpose.stages.nerf.kernels.types import BLOCK, Domain, Rays

NEVER = np.float32(np.inf)


def block_centres(dom: Domain) -> np.ndarray:
    """Centres (n, 3) float32 of the blocks with an occupied cell, in normalised coordinates; space in a box.

    That of a contracted one is in the unit ball, where a cube is a cube.
    """
    blocks = dom.resolution // BLOCK
    z, y, x = np.nonzero(dom.distance.reshape(blocks, blocks, blocks) == 0)
    half = _half_of_cube(dom)
    return ((np.stack([x, y, z], axis=1) + 0.5) * (2 * half / blocks) - half).astype(np.float32)


def block_radius(dom: Domain) -> float:
    """Of the ball around a block, with what rounding may put beside it."""
    return 1.001 * math.sqrt(3) * BLOCK / dom.resolution * _half_of_cube(dom)


def _half_of_cube(dom: Domain) -> float:
    return 2.0 if dom.contracted else 1.0


@njit(inline="always")
def edges(across: float, ahead: float, radius: float, focal: float, centre: float) -> tuple[float, float]:
    """First and last pixel of a ball along an axis of the image; infinite where it reaches beside the camera."""
    reach2 = across * across + ahead * ahead - radius * radius
    if reach2 <= 0:
        return -NEVER, NEVER
    turn, middle = radius / math.sqrt(reach2), across / ahead if ahead > 0 else NEVER
    if ahead <= 0 or middle * turn >= 1 or -middle * turn >= 1:
        return -NEVER, NEVER
    low, high = (middle - turn) / (1 + middle * turn), (middle + turn) / (1 - middle * turn)
    return focal * low + centre, focal * high + centre


@njit(inline="always")
def tile_of(pixel: float, tile: int, tiles: int) -> int:
    """The tile of a pixel along an axis; beside the image, that at its border."""
    return np.int64(min(max(pixel / tile, 0.0), np.float64(tiles - 1)))


@cached_njit(nogil=True, fastmath=FASTMATH)
def tile_limits(
    centres: np.ndarray, radius: float, turn: np.ndarray, origin: np.ndarray, intrinsics: np.ndarray, tile: int,
    limits: np.ndarray,
) -> None:  # fmt: skip
    """Fill limits (rows, columns, 2): between which distances rays of a tile can meet a ball; none where far <= near.

    centres (n, 3) and the camera's origin (3,) in the same coordinates, turn (3, 3) into the camera's axes,
    intrinsics: fx, fy, cx, cy in pixels. A tile has `tile` pixels a side.
    """
    rows, columns = limits.shape[0], limits.shape[1]
    limits[:, :, 0], limits[:, :, 1] = NEVER, 0
    fx, fy, cx, cy = intrinsics
    for i in range(centres.shape[0]):
        x, y, z = centres[i, 0] - origin[0], centres[i, 1] - origin[1], centres[i, 2] - origin[2]
        u = turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z
        v = turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z
        w = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z
        if w < -radius:
            continue
        left, right = edges(u, w, radius, fx, cx)
        top, bottom = edges(v, w, radius, fy, cy)
        # A pixel's ray goes through its middle: half a pixel and rounding are allowed for by a whole one.
        if right < -1 or bottom < -1 or left > tile * columns or top > tile * rows:
            continue
        distance = math.sqrt(u * u + v * v + w * w)
        near, far = np.float32(max(distance - radius, 0.0)), np.float32(distance + radius)
        for row in range(tile_of(top - 1, tile, rows), tile_of(bottom + 1, tile, rows) + 1):
            for column in range(tile_of(left - 1, tile, columns), tile_of(right + 1, tile, columns) + 1):
                limits[row, column, 0] = min(limits[row, column, 0], near)
                limits[row, column, 1] = max(limits[row, column, 1], far)


@inner
def narrow(dom: Domain, near: float, far: float, count: int, rays: Rays) -> None:
    """Hold the packet's rays, which are at their start, between two distances; samples stay where they were."""
    step = np.float32(dom.step)
    for r in range(count):
        rays.far[r] = min(rays.far[r], far)
        if near >= rays.far[r]:
            rays.alive[r] = False
            continue
        if near > rays.t[r]:
            rays.t[r] += step * np.ceil((near - rays.t[r]) / step)
