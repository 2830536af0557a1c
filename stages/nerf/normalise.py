"""Between a caller's rays and the field's: what every renderer shares."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from stages.geometry import Camera, camera_centre
from stages.nerf.metadata import Space
from stages.nerf.rendering_api import RenderedRays, RenderedView

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


@dataclass(frozen=True)
class ViewRays:
    """A camera's rays tile by tile, so that rays traced together read the same table entries.

    order: (n,) row-major pixel indices; unit: (n, 3) float32 unit directions in the camera; length: (n,) of those with
    z = 1; tile: (n,) index of their tiles, row by row.
    """

    order: np.ndarray
    unit: np.ndarray
    length: np.ndarray
    tile: np.ndarray


@lru_cache(maxsize=2)
def view_rays(camera: Camera) -> ViewRays:
    """The rays through every pixel; the same for every pose."""
    order = tile_order(camera.width, camera.height)
    directions = camera.directions(camera.grid()[order])
    length = np.linalg.norm(directions, axis=1)
    y, x = np.divmod(order, camera.width)
    tile = (y // TILE) * -(-camera.width // TILE) + x // TILE
    return ViewRays(order, directions / length[:, None], length, tile)


def tile_view(
    trace: Callable[[np.ndarray, np.ndarray], RenderedRays],
    space: Space,
    camera: Camera,
    cam_from_object: np.ndarray,
    background: np.ndarray,
    hit: np.ndarray | slice = slice(None),
) -> RenderedView:
    """Render a view; `trace` takes origins and unit directions in the field's coordinates.

    hit: (n,) bool, in the order of view_rays, which rays are traced; the others show the background (3,) in 0..1.
    """
    bundle = view_rays(camera)
    unit, length, order = bundle.unit[hit], bundle.length[hit], bundle.order[hit]
    origins = np.empty_like(unit)
    origins[:] = (camera_centre(cam_from_object) - space.centre) / space.scale
    traced = trace(origins, unit @ cam_from_object[:3, :3].astype(np.float32))
    shape = (camera.height, camera.width)
    rgb = np.empty((*shape, 3), np.uint8)
    rgb[:] = background * np.float32(255) + np.float32(0.5)
    depth, opacity = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    rgb.reshape(-1, 3)[order] = traced.rgb * np.float32(255) + np.float32(0.5)
    depth.reshape(-1)[order] = traced.depth * (np.float32(space.scale) / length)
    opacity.reshape(-1)[order] = traced.opacity
    return RenderedView(rgb, depth, opacity, camera, cam_from_object)


def tile_order(width: int, height: int, tile: int = TILE) -> np.ndarray:
    """Row-major pixel indices in the order of square tiles."""
    y, x = np.divmod(np.arange(width * height), width)
    key = ((y // tile) * (-(-width // tile)) + x // tile) * tile * tile + (y % tile) * tile + x % tile
    return np.argsort(key, kind="stable")
