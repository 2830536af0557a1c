"""Where tracks are by cameras held fixed, and how far off their pixels that is: many tracks at once, wrong ones among
them.

Sources: Hartley and Sturm, Triangulation (1997); Holland and Welsch, Robust regression using iteratively reweighted
least-squares (1977).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from fieldpose.stages.geometry import Camera, camera_centres
from fieldpose.stages.structure.posed import PosedCameras
from fieldpose.stages.structure.tracks import Tracks

_STEPS = 10
_LEAST_RESIDUAL_PX = 0.5
"""Residuals count by their length, not its square, down to this, which is about how exact a keypoint is."""
_DAMPING = 1e-6
_TrackPoints = Float64[np.ndarray, "tracks 3"]
_Angles = Float64[np.ndarray, "tracks"]
_Errors = Float64[np.ndarray, "observations"]


@dataclass(frozen=True, eq=False)
class Triangulated:
    """points (tracks, 3) in object coordinates; error_px of each observation, infinite where the point is not ahead of
    the camera; angle_rad of each track: about the widest between two of its rays."""

    points: _TrackPoints
    error_px: _Errors
    angle_rad: _Angles


def triangulate(posed: PosedCameras, tracks: Tracks) -> Triangulated:
    """The point of each track with the least sum of distances in the images."""
    if tracks.count == 0:
        return Triangulated(np.zeros((0, 3)), np.zeros(0), np.zeros(0))
    cam_from_object = posed.cam_from_object
    ideal, focal, usable = _undistorted(posed.cameras, tracks)
    rotation, offset = cam_from_object[tracks.image, :3, :3], cam_from_object[tracks.image, :3, 3]
    centre = camera_centres(cam_from_object)[tracks.image]
    rays = np.einsum("nji,nj->ni", rotation, np.concatenate([ideal, np.ones((len(ideal), 1))], axis=1))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    starts = np.flatnonzero(np.diff(tracks.track, prepend=-1))
    points = _nearest_to_rays(centre, rays, starts)
    for _ in range(_STEPS):
        residual, jacobian, ahead = _residuals(points[tracks.track], rotation, offset, ideal, focal)
        weight = ahead * usable / np.maximum(np.linalg.norm(residual, axis=1), _LEAST_RESIDUAL_PX)
        normal = np.add.reduceat(np.einsum("n,nki,nkj->nij", weight, jacobian, jacobian), starts)
        gradient = np.add.reduceat(np.einsum("n,nki,nk->ni", weight, jacobian, residual), starts)
        normal += (_DAMPING * np.trace(normal, axis1=1, axis2=2) + 1e-12)[:, None, None] * np.eye(3)
        points = points - np.linalg.solve(normal, gradient[..., None])[..., 0]
    residual, _, ahead = _residuals(points[tracks.track], rotation, offset, ideal, focal)
    error = np.where(ahead & usable, np.linalg.norm(residual, axis=1), np.inf)
    return Triangulated(points, error, _widest(rays, starts, tracks))


def _undistorted(cameras: Sequence[Camera], tracks: Tracks) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Observations as (n, 2) in an image of focal length 1, their focal lengths (n, 2), and whether they are any."""
    ideal, focal = np.zeros((len(tracks.image), 2)), np.ones((len(tracks.image), 2))
    usable = np.zeros(len(tracks.image), bool)
    for i in np.unique(tracks.image):
        camera, seen = cameras[i], tracks.image == i
        pixels, usable[seen] = camera.without_distortion(tracks.pixels[seen])
        focal[seen] = camera.fx, camera.fy
        ideal[seen] = (pixels - (camera.cx, camera.cy)) / focal[seen]
    return ideal, focal, usable


def _nearest_to_rays(centre: np.ndarray, rays: np.ndarray, starts: np.ndarray) -> np.ndarray:
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    total = np.add.reduceat(across, starts) + _DAMPING * np.eye(3)
    right = np.add.reduceat(np.einsum("nij,nj->ni", across, centre), starts)
    right += _DAMPING * np.add.reduceat(centre, starts) / np.diff(np.append(starts, len(rays)))[:, None]
    return np.linalg.solve(total, right[..., None])[..., 0]


def _residuals(
    points: np.ndarray, rotation: np.ndarray, offset: np.ndarray, ideal: np.ndarray, focal: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """In pixels (n, 2), their derivatives by the point (n, 2, 3), and whether the point is ahead of the camera."""
    in_cam = np.einsum("nij,nj->ni", rotation, points) + offset
    ahead = in_cam[:, 2] > 0
    z = np.where(ahead, in_cam[:, 2], 1.0)
    projected = in_cam[:, :2] / z[:, None]
    jacobian = (rotation[:, :2] - projected[:, :, None] * rotation[:, 2:]) * (focal / z[:, None])[:, :, None]
    return (projected - ideal) * focal, jacobian, ahead


def _widest(rays: np.ndarray, starts: np.ndarray, tracks: Tracks) -> np.ndarray:
    """Twice the widest angle to the mean ray."""
    mean = np.add.reduceat(rays, starts)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    cosine = np.clip((rays * mean[tracks.track]).sum(axis=1), -1, 1)
    return 2 * np.arccos(np.minimum.reduceat(cosine, starts))
