"""A camera's rays in the order in which a view is rendered: tile by tile."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from fieldpose.stages.geometry import Camera
from fieldpose.stages.nerf.kernels.types import Tiles

TILE = 8
"""Pixels along a tile's side."""


@lru_cache(maxsize=2)
def view_tiles(camera: Camera) -> Tiles:
    """The rays through every pixel; the same for every pose."""
    pixel = tile_order(camera.width, camera.height)
    directions = camera.directions(camera.grid()[pixel])
    length = np.linalg.norm(directions, axis=1)
    y, x = np.divmod(pixel, camera.width)
    columns, rows = -(-camera.width // TILE), -(-camera.height // TILE)
    first = np.searchsorted((y // TILE) * columns + x // TILE, np.arange(rows * columns + 1))
    return Tiles(first, pixel, directions / length[:, None], length)


def tile_order(width: int, height: int) -> np.ndarray:
    """Row-major pixel indices in the order of square tiles."""
    y, x = np.divmod(np.arange(width * height), width)
    key = ((y // TILE) * (-(-width // TILE)) + x // TILE) * TILE * TILE + (y % TILE) * TILE + x % TILE
    return np.argsort(key, kind="stable")
