"""Errors of poses measured on the object's surface, as the BOP benchmark and its forerunners have them.

Sources: Hinterstoisser et al., Model based training, detection and pose estimation (ACCV 2012), for ADD and ADD-S
(there ADI); Xiang et al., PoseCNN (RSS 2018), for the area under the curve.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from scipy.spatial import ConvexHull, QhullError, cKDTree
from scipy.spatial.distance import pdist

from fieldpose.errors import DatasetError
from fieldpose.stages.geometry import points_at_depth
from fieldpose.stages.nerf.metadata import TrainingCamera
from fieldpose.stages.nerf.rendering_api import RayRenderer

SHARE = 0.1
"""Of the diameter: the usual limit of a right pose, and the end of the curve."""
_POINTS, _VIEWS, _SIZE = 2048, 24, 96


@dataclass(frozen=True)
class Surface:
    """Points (n, 3) of an object's surface, in object units."""

    points: np.ndarray

    @cached_property
    def diameter(self) -> float:
        """The largest distance between two of the points."""
        try:
            outermost = self.points[ConvexHull(self.points, qhull_options="QJ").vertices]
        except QhullError:  # too few points
            outermost = self.points
        return float(pdist(outermost).max())


def read_surface(path: Path) -> Surface:
    """Points (n, 3) of a .npy file. Raises DatasetError."""
    try:
        points = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError, BadZipFile) as error:
        raise DatasetError(f"{path}: no readable .npy file of surface points ({error})") from error
    if not isinstance(points, np.ndarray) or points.dtype.kind not in "fiu":
        raise DatasetError(f"{path}: expected one array of numbers, (n, 3)")
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 2 or not np.isfinite(points).all():
        raise DatasetError(f"{path}: expected finite points of shape (n, 3), got {points.dtype} {points.shape}")
    if np.ptp(points, axis=0).max() <= 0:
        raise DatasetError(f"{path}: its points are all at one place, so that errors have no measure")
    return Surface(points.astype(np.float64))


def surface_of(renderer: RayRenderer, cameras: Sequence[TrainingCamera], rng: np.random.Generator) -> Surface | None:
    """What the training views of a field see of its surface; None if they see none."""
    step = max(len(cameras) // _VIEWS, 1)
    seen = [_seen_by(renderer, camera) for camera in cameras[::step]]
    points = np.concatenate(seen) if seen else np.zeros((0, 3))
    if len(points) < 2:
        return None
    return Surface(rng.permutation(points)[:_POINTS].astype(np.float64))


def _seen_by(renderer: RayRenderer, view: TrainingCamera) -> np.ndarray:
    camera, pose = view.camera.undistorted().shrunk(_SIZE), view.pose
    rendered = renderer.render_view(camera, pose)
    y, x = np.nonzero((rendered.opacity > 0.5) & (rendered.depth > 0))
    return points_at_depth(camera, pose, np.stack([x, y], axis=1), rendered.depth[y, x])


def add(cam_from_object: np.ndarray, truth: np.ndarray, surface: Surface) -> float:
    """The mean distance between the surface's points under two poses (4, 4)."""
    return float(np.linalg.norm(_moved(cam_from_object, surface) - _moved(truth, surface), axis=1).mean())


def add_s(cam_from_object: np.ndarray, truth: np.ndarray, surface: Surface) -> float:
    """The mean distance from each point under the true pose to the nearest under the other, for symmetric objects."""
    distances, _ = cKDTree(_moved(cam_from_object, surface)).query(_moved(truth, surface))
    return float(distances.mean())


def area_under_curve(errors: Sequence[float], end: float) -> float:
    """The area under the share of errors below a limit, as the limit goes from 0 to `end`; 1 if all errors are 0."""
    return float(np.clip(1 - np.asarray(errors, float) / end, 0, 1).mean()) if len(errors) else 0.0


def _moved(cam_from_object: np.ndarray, surface: Surface) -> np.ndarray:
    return surface.points @ cam_from_object[:3, :3].T + cam_from_object[:3, 3]
