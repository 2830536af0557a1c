"""Lifting matched pixels to points of the object, and mining those that the field places consistently.

The paper's sections III-A (back-projection with the rendered depth) and III-B (3-D consistent point mining): a
point is looked at again from nearby views, and discarded where they do not see the surface at the same place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fieldpose.bus.messages import Reason
from fieldpose.stages.geometry import Camera, camera_centre, points_at_depth
from fieldpose.stages.geometry.arrays import (
    AnyOpacity,
    Depth,
    Flags,
    Pixels,
    Points,
    Points32,
    Transform,
    Values,
    Values32,
    Vector,
)
from fieldpose.stages.lifting.config import MAX_DEPTH_STEP, MIN_OPACITY, LiftingConfig
from fieldpose.stages.lifting.memory import ConsistencyMemory, Remember
from fieldpose.stages.nerf.rendering_api import RayRenderer

__all__ = ["ConsistencyMemory", "Lifted", "LiftingConfig", "consistency", "depth_at", "lift"]

_NEVER = np.float32(np.finfo(np.float32).max)


@dataclass(frozen=True)
class Lifted:
    """Points, their consistency, the paper's m in squared units, and whether to keep them.

    Points of pixels that show no surface are at the camera's centre, with the largest finite consistency.
    """

    points_in_object: Points32
    consistency: Values32
    kept: Flags


def lift(
    renderer: RayRenderer,
    depth: Depth,
    opacity: AnyOpacity,
    camera: Camera,
    cam_from_object: Transform,
    pixels_in_view: Pixels,
    rng: np.random.Generator,
    config: LiftingConfig | None = None,
    remember: Remember | None = None,
) -> Lifted | Reason:
    """Lift pixels of a view and mark the points to keep.

    depth, opacity, camera and cam_from_object are the view's. `rng` turns the ring of nearby views; the renderer is
    asked once, for all points and views, or for those pixels alone that `remember`, for a view that comes again, does
    not know. TOO_FEW_CONSISTENT_POINTS where less are kept than the configuration asks for.
    """
    config = config or LiftingConfig()
    depths = depth_at(depth, pixels_in_view, MAX_DEPTH_STEP)
    scale = 255.0 if opacity.dtype == np.uint8 else 1.0
    seen = (depths > 0) & (_nearest(opacity, pixels_in_view) >= MIN_OPACITY * scale)
    depths = np.where(seen, depths, 0).astype(np.float32)
    points = points_at_depth(camera, cam_from_object, pixels_in_view, depths)
    spread = np.full(len(points), _NEVER, np.float32)
    if seen.any():
        on_surface, centre = points[seen], camera_centre(cam_from_object)

        def look(index: np.ndarray | slice) -> np.ndarray:
            return consistency(renderer, on_surface[index], centre, rng, config)

        spread[seen] = look(slice(None)) if remember is None else remember(pixels_in_view[seen], look)
    unit = 1.0 if config.gamma_unit == "field" else depths / camera.fx
    displacement = np.where(seen, np.sqrt(spread) / np.maximum(config.gamma * unit, 1e-12), np.inf)
    kept = _consistent(displacement, config)
    return Lifted(points, spread, kept) if kept.sum() >= config.min_kept else Reason.TOO_FEW_CONSISTENT_POINTS


def _consistent(displacement: Values, config: LiftingConfig) -> Flags:
    """Which points to keep by their displacement, in multiples of gamma."""
    ranked = np.sort(displacement)
    last = min(config.enough, len(ranked)) - 1
    enough = ranked[last] if last >= 0 else 0.0
    return displacement <= np.clip(enough, 1.0, max(config.gamma_most, 1.0))


def depth_at(depth: Depth, pixels: Pixels, max_step: float) -> Values32:
    """Depth at pixels: bilinear where the four around it are one surface, else that of the nearest.

    One surface means that they differ by at most the share `max_step`.
    """
    height, width = depth.shape
    corner = np.clip(np.floor(pixels), 0, (max(width - 2, 0), max(height - 2, 0))).astype(int)
    x, y = corner.T
    right, below = np.minimum(x + 1, width - 1), np.minimum(y + 1, height - 1)
    around = np.stack([depth[y, x], depth[y, right], depth[below, x], depth[below, right]])
    lowest, highest = around.min(axis=0), around.max(axis=0)
    smooth = (lowest > 0) & (highest - lowest <= max_step * highest)
    u, v = np.clip(pixels - corner, 0, 1).T
    mixed = np.array([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v]) * around
    return np.where(smooth, mixed.sum(axis=0), _nearest(depth, pixels)).astype(np.float32)


def consistency(
    renderer: RayRenderer,
    points: Points,
    camera_centre: Vector,
    rng: np.random.Generator,
    config: LiftingConfig,
) -> Values32:
    """The paper's m: mean or median squared distance of points from where nearby views see them.

    The views lie on a circle around the camera's centre, at the same distance from the point, evenly spaced.
    """
    if config.views == 0:
        return np.zeros(len(points), np.float32)
    centres = _nearby_centres(points, camera_centre, rng, config)
    directions = points[:, None] - centres
    rendered = renderer.render_rays(centres.reshape(-1, 3), directions.reshape(-1, 3))
    # The point is at parameter 1 of its rays; a ray that meets nothing misses it by its whole distance.
    off = (rendered.depth.reshape(directions.shape[:2]) - 1)[..., None] * directions
    squared = (off**2).sum(axis=2)
    return (np.median if config.statistic == "median" else np.mean)(squared, axis=1).astype(np.float32)


def _nearby_centres(
    points: np.ndarray, camera_centre: np.ndarray, rng: np.random.Generator, config: LiftingConfig
) -> np.ndarray:
    """Camera centres (n, views, 3) float32, `angle_deg` around each point (n, 3) from the given centre (3,).

    Rays to the same point follow each other, since rays that are traced together read the same table entries.
    """
    to_camera = (camera_centre - points).astype(np.float64)
    aside = np.eye(3)[np.argmin(np.abs(to_camera), axis=1)]
    first = np.cross(to_camera, aside)
    first *= np.linalg.norm(to_camera, axis=1, keepdims=True) / np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(to_camera, first) / np.linalg.norm(to_camera, axis=1, keepdims=True)
    around = rng.uniform(0, 2 * np.pi) + 2 * np.pi * np.arange(config.views) / config.views
    sideways = np.cos(around)[:, None] * first[:, None] + np.sin(around)[:, None] * second[:, None]
    angle = np.deg2rad(config.angle_deg)
    return ((points + np.cos(angle) * to_camera)[:, None] + np.sin(angle) * sideways).astype(np.float32)


def _nearest(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    height, width = image.shape
    x, y = np.clip(np.rint(pixels), 0, (width - 1, height - 1)).astype(int).T
    return image[y, x]
