"""Fitting a pose to those of many points that agree on it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from fieldpose.stages.alignment.least_squares import CONVERGED, PoseFit, fit_pose, reprojection_errors_px
from fieldpose.stages.geometry import Camera, twist_covariance
from fieldpose.stages.geometry.arrays import Covariance, Matrices2, Pixels, Points, Transform

_ROUNDS = 3
SHARED_ERROR = 0.6
"""How far neighbouring points err together, as a multiple of the inliers' residuals; found on several scenes."""
SHARED_ERROR_BY_ANGLE = 0.8
"""What is added to it for each radian between the directions of view: what is seen from elsewhere looks different
in ways that neighbours have in common."""


def fit_agreeing(
    pixels: Pixels, points: Points, camera: Camera, cam_from_object: Transform, weights: Matrices2, threshold: float,
    least: int, converged: float = CONVERGED,
) -> tuple[PoseFit | None, Bool[np.ndarray, " points"]]:  # fmt: skip
    """Fit the points within the threshold and choose them anew by the fit, in turn; None where they are too few.

    pixels (n, 2) of an undistorted camera, points (n, 3) in object coordinates, weights (n, 2, 2).
    """
    pose, fit, inliers = cam_from_object, None, np.zeros(len(pixels), bool)
    for _ in range(_ROUNDS):
        agreeing = reprojection_errors_px(pixels, points, camera, pose) <= threshold
        if agreeing.sum() < least:
            return None, agreeing
        if fit is not None and np.array_equal(agreeing, inliers):
            break
        inliers = agreeing
        fit = fit_pose(pixels[inliers], points[inliers], camera, pose, weights[inliers], converged)
        pose = fit.cam_from_object
    return fit, inliers


def covariance_of(fit: PoseFit, pixels: Pixels, longer_side: int, angle: float) -> Covariance:
    """Covariance (6, 6) of a fit's left twist, in object units and radians.

    pixels (n, 2), distorted, of what was fitted; angle: typical one, in radians, between the directions from which
    the points were seen in their views and in the frame.
    """
    shared = SHARED_ERROR + SHARED_ERROR_BY_ANGLE * angle
    jacobian = fit.errors[1]
    return twist_covariance(jacobian, fit.weights, pixels, longer_side, fit.variance, shared**2 * fit.variance_px)
