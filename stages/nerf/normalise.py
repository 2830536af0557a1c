"""Between a caller's rays and the field's: what every renderer shares."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from stages.geometry.cameras import Camera, rays
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


def tile_view(
    render_rays: Callable[[np.ndarray, np.ndarray], RenderedRays], camera: Camera, cam_from_object: np.ndarray
) -> RenderedView:
    """Render a view tile by tile, so that rays traced together read the same table entries."""
    order = tile_order(camera.width, camera.height)
    origins, directions = rays(camera, cam_from_object, camera.grid()[order])
    traced = render_rays(origins, directions)
    shape = (camera.height, camera.width)
    rgb, depth, opacity = np.empty((*shape, 3), np.uint8), np.empty(shape, np.float32), np.empty(shape, np.float32)
    rgb.reshape(-1, 3)[order] = (traced.rgb * 255 + 0.5).astype(np.uint8)
    depth.reshape(-1)[order] = traced.depth
    opacity.reshape(-1)[order] = traced.opacity
    return RenderedView(rgb, depth, opacity, camera, cam_from_object)


def tile_order(width: int, height: int, tile: int = TILE) -> np.ndarray:
    """Row-major pixel indices in the order of square tiles."""
    y, x = np.divmod(np.arange(width * height), width)
    key = ((y // tile) * (-(-width // tile)) + x // tile) * tile * tile + (y % tile) * tile + x % tile
    return np.argsort(key, kind="stable")
