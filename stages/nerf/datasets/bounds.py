"""Where a scene is, told from its cameras: the space that a field of it should cover."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fieldpose.stages.geometry.cameras import Camera
from fieldpose.stages.geometry.rigid import camera_centre, camera_centres, nearest_point_to_axes

_AROUND_THE_VIEW = 1.05
_AROUND_THE_CAMERAS = 1.05
_NEAR_SHARE_OF_RADIUS = 0.05
_COARSEST = 3e-5
"""Step of positions, as a share of how far cameras are spread: a tenth of what poses are found to."""


@dataclass(frozen=True, eq=False)
class SceneBounds:
    """A ball (centre (3,), radius) and a box aabb (2, 3) = (lowest, highest corner), in object coordinates.

    Bounded scenes lie within aabb, and the ball is drawn around it. Of unbounded scenes the ball holds the cameras
    and what they look at, aabb is the cube around the ball, and the rest lies beyond. near and far: the depths
    worth sampling; far is None where it is not known.
    """

    centre: np.ndarray
    radius: float
    aabb: np.ndarray
    near: float
    far: float | None


def object_bounds(cameras: Sequence[Camera], poses: Sequence[np.ndarray]) -> SceneBounds:
    """Bounds of an object that the cameras surround: a cube a little wider than what they see at its distance."""
    centre = nearest_point_to_axes(poses)
    half = max(
        np.linalg.norm(camera_centre(cam_from_object) - centre)
        * max(camera.width / camera.fx, camera.height / camera.fy)
        / 2
        for camera, cam_from_object in zip(cameras, poses, strict=True)
    )
    half *= _AROUND_THE_VIEW
    return box_bounds(np.stack([centre - half, centre + half]), poses)


def box_bounds(aabb: np.ndarray, poses: Sequence[np.ndarray]) -> SceneBounds:
    """Bounds of a scene that lies within a known box (2, 3); cameras may be inside it."""
    centre, radius = aabb.mean(axis=0), float(np.linalg.norm(aabb[1] - aabb[0]) / 2)
    distances = np.linalg.norm(_centres(poses) - centre, axis=1)
    near = max(float(distances.min()) - radius, _NEAR_SHARE_OF_RADIUS * radius)
    return SceneBounds(centre, radius, aabb, near, float(distances.max()) + radius)


def unbounded_bounds(poses: Sequence[np.ndarray], depths: tuple[float, float] | None = None) -> SceneBounds:
    """Bounds of a scene without end; depths: its nearest and farthest content, for cameras that face one way."""
    centres = _centres(poses)
    if depths is None:
        centre = nearest_point_to_axes(poses)
    else:
        harmonic_mean = 2 / (1 / depths[0] + 1 / depths[1])
        centre = centres.mean(axis=0) + harmonic_mean * _mean_direction(poses)
    radius = _AROUND_THE_CAMERAS * float(np.linalg.norm(centres - centre, axis=1).max()) or 1.0
    near = _NEAR_SHARE_OF_RADIUS * radius if depths is None else 0.9 * depths[0]
    aabb = np.stack([centre - radius, centre + radius])
    return SceneBounds(centre, radius, aabb, near, None if depths is None else depths[1])


def too_coarse(poses: np.ndarray) -> str | None:
    """Where cameras (n, 4, 4) are so far from the origin that the 32 bits of points are too few: that in words."""
    centres = camera_centres(poses)
    middle = np.median(centres, axis=0)
    spread = float(np.median(np.linalg.norm(centres - middle, axis=1)))
    step = float(np.spacing(np.float32(np.abs(middle).max())))
    if not step > _COARSEST * spread > 0:
        return None
    offset = ", ".join(f"{value:.0f}" for value in middle)
    return f"the cameras are around ({offset}), where positions are good to {step:.2g} only, in a scene of {spread:.2g}"


def _mean_direction(poses: Sequence[np.ndarray]) -> np.ndarray:
    """Of unit length where all cameras face one way, zero where they look all around."""
    return np.mean([cam_from_object[2, :3] for cam_from_object in poses], axis=0)


def _centres(poses: Sequence[np.ndarray]) -> np.ndarray:
    return np.stack([camera_centre(cam_from_object) for cam_from_object in poses])
