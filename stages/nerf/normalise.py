"""Between a caller's rays and the field's: what every renderer shares."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from stages.geometry import Camera
from stages.nerf.kernels.types import Tiles
from stages.nerf.metadata import Space

TILE = 8


def normalised(
    space: Space, origins: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Origins and unit directions (n, 3) in the field's coordinates, and the length of the directions there (n,)."""
    o = ((np.asarray(origins, np.float64) - space.centre) / space.scale).astype(np.float32)
    d = np.asarray(directions, np.float64) / space.scale
    length = np.linalg.norm(d, axis=1, keepdims=True)
    return o, (d / length).astype(np.float32), length[:, 0].astype(np.float32)


def by_object_rays(space: Space, jacobian: np.ndarray, unit: np.ndarray, length: np.ndarray) -> np.ndarray:
    """A jacobian (n, k, 6) by normalised origin and unit direction, turned into one by the caller's rays."""
    scale = np.float32(space.scale)
    by_unit = jacobian[..., 3:]
    along = np.sum(by_unit * unit[:, None], axis=-1, keepdims=True)
    by_direction = (by_unit - along * unit[:, None]) / (length[:, None, None] * scale)
    return np.concatenate([jacobian[..., :3] / scale, by_direction], axis=-1)


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


def tile_order(width: int, height: int, tile: int = TILE) -> np.ndarray:
    """Row-major pixel indices in the order of square tiles."""
    y, x = np.divmod(np.arange(width * height), width)
    key = ((y // tile) * (-(-width // tile)) + x // tile) * tile * tile + (y % tile) * tile + x % tile
    return np.argsort(key, kind="stable")
