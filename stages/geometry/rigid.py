"""Rigid transforms as plain 4x4 float64 matrices, and their Lie algebra se(3).

A twist is (translation 3, rotation 3). Small changes of a pose multiply from the left:
``cam_from_object_new = exp_se3(xi) @ cam_from_object``; 6x6 covariances of a pose are covariances of that xi. scipy's
RigidTransform is no more exact and takes half as long again for a single exponential or logarithm, and 17 times as long
for an inverse.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from fieldpose.errors import GeometryError
from fieldpose.stages.geometry.arrays import Matrix3, Matrix6, Points, Transform, Transforms, Twist, Vector

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

_SMALL_ANGLE = 1e-4


def skew(vector: ArrayLike) -> Matrix3:
    """The matrix whose product with u is vector x u."""
    x, y, z = np.asarray(vector, dtype=np.float64)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def from_rotation(rotation: Rotation | ArrayLike, translation: ArrayLike = (0.0, 0.0, 0.0)) -> Transform:
    """Put a rotation (scipy Rotation or (3, 3)) and a translation (3,) together."""
    transform = np.eye(4)
    transform[:3, :3] = rotation.as_matrix() if hasattr(rotation, "as_matrix") else rotation
    transform[:3, 3] = translation
    return transform


def exp_se3(twist: ArrayLike) -> Transform:
    """The rigid transform of a twist (6,); Lynch and Park, Modern Robotics, eq. 3.88."""
    from scipy.spatial.transform import Rotation

    translation, rotation = np.split(np.asarray(twist, dtype=np.float64), 2)
    angle = float(np.linalg.norm(rotation))
    cross = skew(rotation)
    if angle < _SMALL_ANGLE:
        first, second = 0.5 - angle**2 / 24, 1 / 6 - angle**2 / 120
    else:
        first, second = 2 * np.sin(angle / 2) ** 2 / angle**2, (angle - np.sin(angle)) / angle**3
    left_jacobian = np.eye(3) + first * cross + second * cross @ cross
    return from_rotation(Rotation.from_rotvec(rotation), left_jacobian @ translation)


def log_se3(transform: Transform) -> Twist:
    """The twist of a rigid transform, with a rotation of at most pi; Modern Robotics, eq. 3.91 and 3.92."""
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_matrix(transform[:3, :3]).as_rotvec()
    angle = float(np.linalg.norm(rotation))
    cross = skew(rotation)
    half = angle / 2
    second = 1 / 12 + angle**2 / 720 if angle < _SMALL_ANGLE else (1 - half / np.tan(half)) / angle**2
    inverse_left_jacobian = np.eye(3) - 0.5 * cross + second * cross @ cross
    return np.concatenate([inverse_left_jacobian @ transform[:3, 3], rotation])


def inverse(transform: Transform) -> Transform:
    """source_from_target of a rigid target_from_source."""
    rotation = transform[:3, :3].T
    return from_rotation(rotation, -rotation @ transform[:3, 3])


def adjoint(transform: Transform) -> Matrix6:
    """The matrix with ``T @ exp_se3(x) @ inverse(T) == exp_se3(adjoint(T) @ x)``."""
    rotation = transform[:3, :3]
    result = np.zeros((6, 6))
    result[:3, :3] = result[3:, 3:] = rotation
    result[:3, 3:] = skew(transform[:3, 3]) @ rotation
    return result


RIGID_TOLERANCE = 1e-3
"""How far what comes from outside may be from a rigid transform, as rounded numbers are."""


def is_rigid(transform: ArrayLike, tolerance: float = 1e-4) -> bool:
    """Whether this is a finite (4, 4) matrix of a right-handed rotation, a translation and the row 0 0 0 1."""
    matrix = np.asarray(transform, dtype=np.float64)
    if matrix.shape != (4, 4) or not np.all(np.isfinite(matrix)):
        return False
    rotation = matrix[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        return bool(
            np.allclose(matrix[3], (0, 0, 0, 1), rtol=0, atol=tolerance)
            and np.allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=tolerance)
            and np.linalg.det(rotation) > 0
        )


def nearest_rigid(transform: Transform) -> Transform:
    """Replace the upper left (3, 3) by the rotation nearest to it in the Frobenius norm; keep the translation.

    Source: Arun, Huang and Blostein, Least-squares fitting of two 3-D point sets (1987).
    """
    left, _, right = np.linalg.svd(np.asarray(transform, dtype=np.float64)[:3, :3])
    handedness = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    return from_rotation(left @ handedness @ right, transform[:3, 3])


def rotation_about(axis: ArrayLike, angle_rad: float) -> Transform:
    """Rotation by angle_rad about an axis (3,) through the origin. GeometryError if the axis is zero."""
    from scipy.spatial.transform import Rotation

    return from_rotation(Rotation.from_rotvec(angle_rad * _unit(axis, "the axis of a rotation")))


def interpolate(start: Transform, end: Transform, alpha: float) -> Transform:
    """The transform a share alpha along the screw motion from start (0) to end (1); alpha beyond 1 extrapolates."""
    return exp_se3(alpha * log_se3(end @ inverse(start))) @ start


def look_at(eye: ArrayLike, target: ArrayLike, up: ArrayLike) -> Transform:
    """cam_from_object (OpenCV axes) of a camera at eye that looks at target with up towards the image's top.

    Raises GeometryError if eye and target coincide or up is parallel to the viewing direction.
    """
    centre = np.asarray(eye, dtype=np.float64)
    forward = _unit(np.asarray(target, dtype=np.float64) - centre, "the viewing direction of look_at")
    right = _unit(np.cross(forward, _unit(up, "up of look_at")), "up of look_at, across the viewing direction,")
    object_from_cam = from_rotation(np.stack([right, np.cross(forward, right), forward], axis=1), centre)
    return inverse(object_from_cam)


def camera_centre(cam_from_object: Transform) -> Vector:
    """Where the camera is, in object coordinates."""
    return -cam_from_object[:3, :3].T @ cam_from_object[:3, 3]


def camera_centres(cam_from_object: Transforms) -> Points:
    """camera_centre of each of several poses."""
    return -np.einsum("nji,nj->ni", cam_from_object[:, :3, :3], cam_from_object[:, :3, 3])


def nearest_point_to_axes(cam_from_object: Sequence[Transform] | Transforms) -> Vector:
    """The point (3,) with the least sum of squared distances to the optical axes.

    Where the axes do not meet in front of the cameras: ahead of their middle, as far as the cameras are spread if
    they all face one way, and in their middle if they look all around.
    """
    centres, forwards = camera_centres(np.asarray(cam_from_object)), np.asarray(cam_from_object)[:, 2, :3]
    across = np.eye(3) - forwards[:, :, None] * forwards[:, None, :]
    total = across.sum(axis=0)
    middle = centres.mean(axis=0)
    if np.linalg.eigvalsh(total)[0] > 1e-6 * len(centres):
        point = np.linalg.solve(total, (across @ centres[:, :, None]).sum(axis=0)[:, 0])
        if np.median(np.einsum("ij,ij->i", point - centres, forwards)) > 0:
            return point
    spread = float(np.linalg.norm(centres - middle, axis=1).max())
    return middle + (spread if spread > 0 else 1.0) * forwards.mean(axis=0)


def _unit(vector: ArrayLike, what: str) -> np.ndarray:
    values = np.asarray(vector, dtype=np.float64)
    length = float(np.linalg.norm(values))
    if values.shape != (3,) or not 1e-12 < length < np.inf:
        raise GeometryError(f"{what} must be a finite vector of 3 numbers that is not zero, got {values.tolist()}")
    return values / length
