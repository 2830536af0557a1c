"""The pose that fits correspondences best once the wrong ones are gone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stages.geometry import Camera, exp_se3

_MAX_STEPS = 20
_CONVERGED = 1e-6
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
        delta = _huber_width(self.residuals_px, self.weights)
        freedom = max(2 * len(length) - 6, 1)
        slope = np.where(length <= delta, 1.0, delta / (2 * np.maximum(length, 1e-12))).mean()
        return float((np.minimum(length, delta) ** 2).sum() / freedom / slope**2)


def fit_pose(
    pixels: np.ndarray, points: np.ndarray, camera: Camera, cam_from_object: np.ndarray, weights: np.ndarray
) -> PoseFit:
    """Minimise Huber's loss of the reprojection errors by Levenberg-Marquardt, from a pose near the minimum.

    pixels (n, 2) of an undistorted camera, points (n, 3) in object coordinates, weights (n,) of squared errors.
    """
    pose, damping = cam_from_object, 1e-6
    residuals, jacobian = reprojection(pixels, points, camera, pose)
    for _ in range(_MAX_STEPS):
        delta = _huber_width(residuals, weights)
        cost = _huber_cost(residuals, weights, delta)
        step = _step(residuals, jacobian, weights * _huber_weights(residuals, weights, delta), damping)
        moved = exp_se3(step) @ pose
        new_residuals, new_jacobian = reprojection(pixels, points, camera, moved)
        if _huber_cost(new_residuals, weights, delta) <= cost:
            pose, residuals, jacobian, damping = moved, new_residuals, new_jacobian, damping / 10
        else:
            damping *= 100
        if np.linalg.norm(step) < _CONVERGED:
            break
    return PoseFit(pose, residuals, jacobian, weights)


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


def _step(residuals: np.ndarray, jacobian: np.ndarray, weights: np.ndarray, damping: float) -> np.ndarray:
    weighted = (weights[:, None, None] * jacobian).reshape(-1, 6)
    hessian = weighted.T @ jacobian.reshape(-1, 6)
    hessian[np.diag_indices(6)] *= 1 + damping
    return -np.linalg.solve(hessian + 1e-12 * np.eye(6), weighted.T @ residuals.ravel())


def _lengths(residuals: np.ndarray, weights: np.ndarray) -> np.ndarray:
    return np.sqrt(weights) * np.linalg.norm(residuals, axis=1)


def _huber_width(residuals: np.ndarray, weights: np.ndarray) -> float:
    return max(_HUBER * float(np.median(_lengths(residuals, weights))) / _MEDIAN_TO_SIGMA, 1e-6)


def _huber_weights(residuals: np.ndarray, weights: np.ndarray, delta: float) -> np.ndarray:
    return np.minimum(1.0, delta / np.maximum(_lengths(residuals, weights), 1e-12))


def _huber_cost(residuals: np.ndarray, weights: np.ndarray, delta: float) -> float:
    length = _lengths(residuals, weights)
    return float(np.where(length <= delta, length**2, delta * (2 * length - delta)).sum())
