"""A frame for cameras that have none: z up from what the object stands on, the origin on it, and a unit.

Source: Fischler and Bolles, Random sample consensus (1981), for the plane.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fieldpose.stages.geometry import Similarity, camera_centres, nearest_point_to_axes
from fieldpose.stages.geometry.arrays import Points64, Transforms, Vector

_TRIALS = 2000
_THICKNESS = 0.02
"""Of the plane, as a share of the median distance of the cameras from what they look at."""
_LEAST_SHARE = 0.15
"""Of the points: a floor has more of them than any plane that is drawn through a heap by chance."""
_LEAST_ABOVE = 0.9
"""Of the cameras and of the points, with its thickness: nothing is below what the object stands on."""
_DENSER = 2.0
"""Points on a plane are so many times more than those as near again to it: in a heap they are about as many."""
_STEEPEST_DEG = 50.0
"""Between the plane's normal and where cameras have their up in the mean: else it is a wall."""


@dataclass(frozen=True, eq=False)
class Standing:
    """object_from_map: brings cameras into the new frame, whose unit is the median distance of the cameras from what
    they look at. on_plane: whether up is a plane's, or else the mean of what is up for the cameras."""

    object_from_map: Similarity
    on_plane: bool


def stand(cam_from_map: Transforms, points: Points64) -> Standing:
    """A frame for cameras (n, 4, 4) and what they show (m, 3)."""
    centres, focus = camera_centres(cam_from_map), nearest_point_to_axes(cam_from_map)
    unit = distance_of_focus(cam_from_map)
    plane = plane_under(cam_from_map, points)
    up, origin = (
        (mean_up(cam_from_map), focus)
        if plane is None
        else (plane[0], focus - (plane[0] @ focus - plane[1]) * plane[0])
    )
    rotation = _upright(up, centres[0] - focus)
    return Standing(Similarity(1 / unit, rotation, -rotation @ origin / unit), plane is not None)


def plane_under(cam_from_map: Transforms, points: Points64) -> tuple[Vector, float] | None:
    """What the object stands on that cameras (n, 4, 4) look at, of what they show (m, 3); see dominant_plane."""
    thickness = _THICKNESS * distance_of_focus(cam_from_map)
    return dominant_plane(points, camera_centres(cam_from_map), mean_up(cam_from_map), thickness)


def distance_of_focus(cam_from_map: Transforms) -> float:
    """Median distance of cameras (n, 4, 4) from what they look at."""
    apart = camera_centres(cam_from_map) - nearest_point_to_axes(cam_from_map)
    return float(np.median(np.linalg.norm(apart, axis=1)))


def mean_up(cam_from_map: Transforms) -> Vector:
    """Unit direction that is up for cameras held upright, in the mean: y of images points down."""
    up = -cam_from_map[:, 1, :3].sum(axis=0)
    length = float(np.linalg.norm(up))
    return up / length if length > 1e-9 else np.array([0.0, 0.0, 1.0])


def dominant_plane(points: Points64, centres: Points64, up: Vector, thickness: float) -> tuple[Vector, float] | None:
    """Unit normal n and offset d, n @ x = d, of the plane that most points lie on and next to nothing below; or None.

    The normal points to the cameras' centres, and about `up`.
    """
    if len(points) < 3:
        return None
    rng = np.random.default_rng(0)
    corners = points[rng.integers(0, len(points), (_TRIALS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals = normals[lengths > 1e-12] / lengths[lengths > 1e-12, None]
    normals *= np.where(normals @ up < 0, -1.0, 1.0)[:, None]
    corners = corners[lengths > 1e-12]
    best, most = None, _LEAST_SHARE * len(points)
    for normal, corner in zip(normals, corners[:, 0], strict=True):
        if normal @ up < np.cos(np.radians(_STEEPEST_DEG)):
            continue
        height = (points - corner) @ normal
        on_it = np.abs(height) <= thickness
        above = min((height >= -thickness).mean(), ((centres - corner) @ normal > 0).mean())
        beside = (np.abs(height) <= 2 * thickness).sum() - on_it.sum()
        if on_it.sum() > max(most, _DENSER * beside) and above >= _LEAST_ABOVE:
            best, most = on_it, on_it.sum()
    if best is None:
        return None
    middle = points[best].mean(axis=0)
    normal = np.linalg.svd(points[best] - middle, full_matrices=False)[2][2]
    normal = normal if normal @ up > 0 else -normal
    return normal, float(normal @ middle)


def _upright(up: Vector, towards: Vector) -> np.ndarray:
    """Rotation (3, 3) whose z is up, and whose x is where the first camera is."""
    x = towards - (towards @ up) * up
    if np.linalg.norm(x) < 1e-9:
        x = np.cross(up, [1.0, 0, 0] if abs(up[0]) < 0.9 else [0, 1.0, 0])
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])
