"""How far one pose is from another, and how differently they see."""

from __future__ import annotations

import numpy as np

from fieldpose.stages.geometry.arrays import Covariance, Points, Transform, Values
from fieldpose.stages.geometry.rigid import camera_centre, inverse, log_se3


def rotation_error_deg(cam_from_object_a: Transform, cam_from_object_b: Transform) -> float:
    """The angle of the rotation between two poses, 0 to 180 degrees."""
    # Processes that have no poses do without scipy, which takes 0.15 s to import.
    from scipy.spatial.transform import Rotation

    between = Rotation.from_matrix(cam_from_object_a[:3, :3] @ cam_from_object_b[:3, :3].T)
    return float(np.rad2deg(between.magnitude()))


def translation_error(cam_from_object_a: Transform, cam_from_object_b: Transform) -> float:
    """The distance between the two camera centres, in object units."""
    return float(np.linalg.norm(camera_centre(cam_from_object_a) - camera_centre(cam_from_object_b)))


def mahalanobis_squared(cam_from_object: Transform, covariance: Covariance, truth: Transform) -> float:
    """The squared error of a pose by the covariance of its left twist: chi squared if that is true."""
    twist = log_se3(truth @ inverse(cam_from_object))
    return float(twist @ np.linalg.pinv(covariance) @ twist)


def viewing_angles(points: Points, cam_from_object_a: Transform, cam_from_object_b: Transform) -> Values:
    """The angles in radians between the directions in which two cameras see points of the object."""
    first, second = points - camera_centre(cam_from_object_a), points - camera_centre(cam_from_object_b)
    cosine = (first * second).sum(axis=1) / np.linalg.norm(first, axis=1) / np.linalg.norm(second, axis=1)
    return np.arccos(np.clip(cosine, -1, 1))
