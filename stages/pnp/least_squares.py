"""The pose that fits correspondences best once the wrong ones are gone."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from stages.geometry import Camera, exp_se3

_MAX_STEPS = 20
CONVERGED = 1e-5
_HUBER = 1.345
_MEDIAN_TO_SIGMA = 1.1774
"""The median length of a 2-D Gaussian of unit sigma is this; Huber's constant is for a known sigma."""


@dataclass(frozen=True)
class PoseFit:
    """cam_from_object (4, 4), the residuals (n, 2) in pixels with derivatives (n, 2, 6), weights (n,)."""

    cam_from_object: np.ndarray
    residuals_px: np.ndarray
    jacobian: np.ndarray
    weights: np.ndarray

    @property
    def variance(self) -> float:
        """Of a residual of weight 1 as Huber's loss sees it; Huber, Robust Statistics (1981), section 7.6."""
        length = _lengths(self.residuals_px, self.weights)
        delta = _huber_width(length)
        freedom = max(2 * len(length) - 6, 1)
        slope = np.where(length <= delta, 1.0, delta / (2 * np.maximum(length, 1e-12))).mean()
        return float((np.minimum(length, delta) ** 2).sum() / freedom / slope**2)


def fit_pose(
    pixels: np.ndarray,
    points: np.ndarray,
    camera: Camera,
    cam_from_object: np.ndarray,
    weights: np.ndarray,
    converged: float = CONVERGED,
) -> PoseFit:
    """Minimise Huber's loss of the reprojection errors by Levenberg-Marquardt, from a pose near the minimum.

    pixels (n, 2) of an undistorted camera, points (n, 3) in object coordinates, weights (n,) of squared errors;
    converged: the length of a twist, in radians and shares of the points' distance, that is the last step.
    """
    pose, damping = cam_from_object, 1e-6
    pixels, points, weights = (np.ascontiguousarray(given, np.float64) for given in (pixels, points, weights))
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    lengths, moved_lengths = np.empty(len(points)), np.empty(len(points))
    gradient, hessian = np.empty(6), np.empty((6, 6))
    distance = np.linalg.norm(np.median(points, axis=0) @ pose[:3, :3].T + pose[:3, 3])
    unit = np.array([max(distance, 1e-12)] * 3 + [1.0] * 3)
    weighted_lengths(pixels, points, intrinsics, pose, weights, lengths)
    for _ in range(_MAX_STEPS):
        delta = _huber_width(lengths)
        normal_equations(pixels, points, intrinsics, pose, weights, delta, gradient, hessian)
        hessian[np.diag_indices(6)] *= 1 + damping
        step = -np.linalg.solve(hessian + 1e-12 * np.eye(6), gradient)
        moved = exp_se3(step) @ pose
        weighted_lengths(pixels, points, intrinsics, moved, weights, moved_lengths)
        if _huber_cost(moved_lengths, delta) <= _huber_cost(lengths, delta):
            pose, damping = moved, damping / 10
            lengths, moved_lengths = moved_lengths, lengths
        else:
            damping *= 100
        if np.linalg.norm(step / unit) < converged:
            break
    return PoseFit(pose, *reprojection(pixels, points, camera, pose), weights)


@njit(inline="always")
def ideal(pose: np.ndarray, point: np.ndarray) -> tuple[float, float, float]:
    """Where a point is in an image of focal length 1, and its depth; where that is not positive, it alone counts."""
    p0, p1, p2 = point
    z = pose[2, 0] * p0 + pose[2, 1] * p1 + pose[2, 2] * p2 + pose[2, 3]
    inverse = 1 / z if z > 0 else 0.0
    u = (pose[0, 0] * p0 + pose[0, 1] * p1 + pose[0, 2] * p2 + pose[0, 3]) * inverse
    v = (pose[1, 0] * p0 + pose[1, 1] * p1 + pose[1, 2] * p2 + pose[1, 3]) * inverse
    return u, v, z


@njit(nogil=True, cache=True)
def weighted_lengths(
    pixels: np.ndarray, points: np.ndarray, intrinsics: np.ndarray, pose: np.ndarray, weights: np.ndarray,
    out: np.ndarray,
) -> None:  # fmt: skip
    """Reprojection errors out (n,), each times the root of its weight; infinite behind the camera. All float64."""
    fx, fy, cx, cy = intrinsics
    for i in range(points.shape[0]):
        u, v, z = ideal(pose, points[i])
        if z <= 0:
            out[i] = np.inf
            continue
        x, y = fx * u + cx - pixels[i, 0], fy * v + cy - pixels[i, 1]
        out[i] = math.sqrt(weights[i] * (x * x + y * y))


@njit(nogil=True, cache=True)
def normal_equations(
    pixels: np.ndarray, points: np.ndarray, intrinsics: np.ndarray, pose: np.ndarray, weights: np.ndarray,
    delta: float, gradient: np.ndarray, hessian: np.ndarray,
) -> None:  # fmt: skip
    """Fill the gradient (6,) and Gauss-Newton's Hessian (6, 6) of Huber's loss by the left twist of a pose (4, 4).

    `reprojection` has the residuals and derivatives; points behind the camera count for nothing.
    """
    fx, fy, cx, cy = intrinsics
    gradient[:] = 0
    hessian[:] = 0
    rows = np.empty((2, 6))
    for i in range(points.shape[0]):
        u, v, z = ideal(pose, points[i])
        if z <= 0:
            continue
        x, y = fx * u + cx - pixels[i, 0], fy * v + cy - pixels[i, 1]
        length = math.sqrt(weights[i] * (x * x + y * y))
        weight = weights[i] * (1.0 if length <= delta else delta / length)
        rows[0, 0], rows[0, 1], rows[0, 2] = fx / z, 0.0, -fx * u / z
        rows[0, 3], rows[0, 4], rows[0, 5] = -fx * u * v, fx * (1 + u * u), -fx * v
        rows[1, 0], rows[1, 1], rows[1, 2] = 0.0, fy / z, -fy * v / z
        rows[1, 3], rows[1, 4], rows[1, 5] = -fy * (1 + v * v), fy * u * v, fy * u
        for a in range(6):
            gradient[a] += weight * (rows[0, a] * x + rows[1, a] * y)
            for b in range(a + 1):
                hessian[a, b] += weight * (rows[0, a] * rows[0, b] + rows[1, a] * rows[1, b])
    for a in range(6):
        for b in range(a):
            hessian[b, a] = hessian[a, b]


def reprojection(
    pixels: np.ndarray, points: np.ndarray, camera: Camera, cam_from_object: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (n, 2) in pixels and their derivative (n, 2, 6) by the left twist; infinite behind the camera."""
    in_cam = points @ cam_from_object[:3, :3].T + cam_from_object[:3, 3]
    x, y, z = in_cam.T
    inverse = 1 / np.where(z > 1e-9, z, 1e-9)
    u, v = x * inverse, y * inverse
    zero = np.zeros_like(u)
    jacobian = np.empty((len(points), 2, 6))
    jacobian[:, 0] = np.stack([inverse, zero, -u * inverse, -u * v, 1 + u * u, -v], axis=1)
    jacobian[:, 1] = np.stack([zero, inverse, -v * inverse, -1 - v * v, u * v, u], axis=1)
    jacobian *= np.array([camera.fx, camera.fy])[:, None]
    residuals = np.stack([camera.fx * u + camera.cx, camera.fy * v + camera.cy], axis=1) - pixels
    residuals[z <= 0] = np.inf
    return residuals, jacobian


def _lengths(residuals: np.ndarray, weights: np.ndarray) -> np.ndarray:
    return np.sqrt(weights) * np.linalg.norm(residuals, axis=1)


def _huber_width(lengths: np.ndarray) -> float:
    middle = len(lengths) // 2
    return max(_HUBER * float(np.partition(lengths, middle)[middle]) / _MEDIAN_TO_SIGMA, 1e-6)


def _huber_cost(lengths: np.ndarray, delta: float) -> float:
    return float(np.where(lengths <= delta, lengths**2, delta * (2 * lengths - delta)).sum())
