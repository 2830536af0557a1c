"""Views of a field from which its surface is made: depth, which way it faces, colour."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from fieldpose.stages.geometry import Camera, points_at_depth
from fieldpose.stages.nerf.metadata import TrainingCamera
from fieldpose.stages.nerf.rendering_api import RayRenderer, RenderedView
from fieldpose.stages.nerf.surface.kernels import DepthViews, look

OPAQUE, EMPTY = 0.5, 0.1
"""Opacities above which a pixel has a depth, and below which it shows that nothing is there."""
MOST_VIEWS, MOST_PIXELS = 128, 640
"""Of the training views so many, evenly spread, with so long a side: more made the demo's surface no better."""
_CONTESTED = 3.0
_CHUNK = 8192
Pose = tuple[Camera, np.ndarray]


@dataclass(frozen=True)
class Seen:
    """What a view sees: points (n, 3) float64 and unit normals (n, 3) float32 towards it, in object coordinates.

    facing (n,): the cosine between a normal and the way to the camera.
    """

    points: np.ndarray
    normals: np.ndarray
    facing: np.ndarray


@dataclass(frozen=True)
class Agreement:
    """What all views say of points: colours (n, 3) uint8, and the weights (n,) of those that see it and see past it."""

    colours: np.ndarray
    seen: np.ndarray
    past: np.ndarray

    @property
    def agreed(self) -> np.ndarray:
        """(n,) bool: points that a view sees and that not many more see something behind of."""
        return (self.seen > 0) & (self.past <= _CONTESTED * self.seen)


def training_poses(cameras: Sequence[TrainingCamera]) -> list[Pose]:
    """Undistorted cameras and poses of the training views that the surface is made from."""
    chosen = np.unique(np.linspace(0, len(cameras) - 1, min(MOST_VIEWS, len(cameras))).astype(int))
    return [(cameras[i].camera.undistorted().shrunk(MOST_PIXELS), cameras[i].pose) for i in chosen]


def depth_views(renderer: RayRenderer, cameras: Sequence[Pose], background: tuple[float, float, float]) -> DepthViews:
    """Render a field for (undistorted camera, cam_from_object) each. 8 bytes a pixel are held.

    background: the colour (0 to 1) that the field renders behind everything.
    """
    height, width = (max(getattr(camera, side) for camera, _ in cameras) for side in ("height", "width"))
    shape = (len(cameras), height, width)
    views = DepthViews(
        size=np.array([(camera.width, camera.height) for camera, _ in cameras]),
        lens=np.array([(c.fx, c.fy, c.cx, c.cy) for c, _ in cameras], np.float32),
        turn=np.array([pose[:3, :3] for _, pose in cameras], np.float32),
        shift=np.array([pose[:3, 3] for _, pose in cameras], np.float32),
        depth=np.zeros(shape, np.float32),
        facing=np.zeros(shape, np.uint8),
        rgb=np.zeros((*shape, 3), np.uint8),
    )
    for i, (camera, pose) in enumerate(cameras):
        rendered = renderer.render_view(camera, pose)
        part = (i, slice(camera.height), slice(camera.width))
        views.depth[part] = known_depth(rendered)
        views.facing[part] = np.rint(255 * facing(camera, views.depth[part]))
        views.rgb[part] = _own_colour(rendered, background)
    return views


def known_depth(view: RenderedView) -> np.ndarray:
    """Depth (h, w) float32, infinite where the view shows nothing, and 0 where it is neither opaque nor empty."""
    depth = np.where(view.opacity > OPAQUE, view.depth, np.float32(0))
    return np.where(view.opacity < EMPTY, np.float32(np.inf), depth)


def _own_colour(view: RenderedView, background: tuple[float, float, float]) -> np.ndarray:
    """Colours (h, w, 3) uint8 without the share of the background, where the view is opaque."""
    opacity = np.maximum(view.opacity, OPAQUE)[..., None]
    behind = 255 * np.array(background, np.float32)
    return np.clip(np.rint((view.rgb - (1 - opacity) * behind) / opacity), 0, 255).astype(np.uint8)


def seen_by(views: DepthViews, v: int) -> Seen:
    """What one of the views sees."""
    (width, height), (fx, fy, cx, cy) = views.size[v].tolist(), views.lens[v].tolist()
    camera, depth = Camera(width, height, fx, fy, cx, cy), views.depth[v, :height, :width]
    row, column = np.nonzero((depth > 0) & np.isfinite(depth) & (views.facing[v, :height, :width] > 0))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = views.turn[v], views.shift[v]
    pixels = np.stack([column, row], axis=1)
    points = points_at_depth(camera, pose, pixels, depth[row, column]).astype(np.float64)
    normals = normals_of(camera, depth)[row, column] @ views.turn[v]
    return Seen(points, normals, views.facing[v, row, column] / np.float32(255))


def agreement(
    views: DepthViews, points: np.ndarray, normals: np.ndarray, tolerance: float, threads: int = 1
) -> Agreement:
    """What all views say of points (n, 3) with unit normals (n, 3), seen at their depth up to `tolerance`.

    Colours are means over the views that see a point, weighted by how they face it and by the inverse of their squared
    distance: of what shines, the part that all of them share.
    """
    n = len(points)
    colours, seen, past = np.empty((n, 3), np.float32), np.empty(n, np.float32), np.empty(n, np.float32)
    at, facing = np.ascontiguousarray(points, np.float32), np.ascontiguousarray(normals, np.float32)

    def part(first: int) -> None:
        look(views, at, facing, np.float32(tolerance), first, min(first + _CHUNK, n), colours, seen, past)

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(part, range(0, n, _CHUNK)))
    return Agreement(np.rint(colours).astype(np.uint8), seen, past)


def normals_of(camera: Camera, depth: np.ndarray) -> np.ndarray:
    """Unit normals (h, w, 3) float32 of the surface in the camera's axes, towards it; 0 where a neighbour is missing.

    Each from the neighbour, left or right and above or below, that is the nearer in depth: it is on the same surface.
    """
    solid = (depth > 0) & np.isfinite(depth)
    points = points_at_depth(camera, np.eye(4), camera.grid(), np.where(solid, depth, 0).ravel())
    points = points.reshape(*depth.shape, 3)
    along = _nearer_difference(points, solid, 1)
    down = _nearer_difference(points, solid, 0)
    normals = np.cross(down, along)
    length = np.linalg.norm(normals, axis=2, keepdims=True)
    return np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)


def facing(camera: Camera, depth: np.ndarray) -> np.ndarray:
    """The cosine (h, w) between normals and the way to the camera; 1 where nothing is seen, 0 where it is not known."""
    towards = -camera.directions(camera.grid()).reshape(*depth.shape, 3)
    towards /= np.linalg.norm(towards, axis=2, keepdims=True)
    cosine = np.einsum("hwc,hwc->hw", normals_of(camera, depth), towards)
    return np.where(np.isinf(depth), 1.0, np.clip(cosine, 0, 1))


def _nearer_difference(points: np.ndarray, solid: np.ndarray, axis: int) -> np.ndarray:
    """Of each point to the next or from the one before, whichever differs less in depth; 0 without any."""
    step = np.diff(points, axis=axis)
    both = np.take(solid, range(1, solid.shape[axis]), axis) & np.take(solid, range(solid.shape[axis] - 1), axis)
    far = np.where(both, np.abs(step[..., 2]), np.inf)
    pad = [(0, 0), (0, 0), (0, 0)]
    pad[axis] = (0, 1)
    ahead, ahead_far = np.pad(step, pad), np.pad(far, pad[:2], constant_values=np.inf)
    pad[axis] = (1, 0)
    behind, behind_far = np.pad(step, pad), np.pad(far, pad[:2], constant_values=np.inf)
    nearer = np.where((ahead_far <= behind_far)[..., None], ahead, behind)
    return np.where(np.isfinite(np.minimum(ahead_far, behind_far))[..., None], nearer, 0)
