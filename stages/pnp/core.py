"""The pose from correspondences between pixels of a frame and points of the object: RANSAC, refinement, checks.

Sources: Fischler and Bolles, Random sample consensus (1981); Chum, Matas and Kittler, Locally optimized RANSAC
(2003), both in OpenCV's implementation.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from stages.geometry import Camera, twist_covariance, viewing_angles
from stages.geometry.rigid import from_rotation
from stages.pnp.config import PnpConfig
from stages.pnp.least_squares import PoseFit, fit_pose, reprojection

__all__ = ["PnpConfig", "PnpResult", "solve"]

_MIN_POINTS = 4
_ROUNDS = 3
_LEAST_CONFIDENCE = 0.01
_REFERENCE_SIDE_PX = 400


@dataclass(frozen=True)
class PnpResult:
    """ok and a reason that is a value of bus.messages.Reason; the rest is None, and inliers false, where not ok.

    inliers: (n,) bool.  residual_px: root mean square over the inliers.  covariance: (6, 6) of the left twist
    (translation, rotation) of cam_from_object, in the object's unit and radians.
    """

    ok: bool
    reason: str
    cam_from_object: np.ndarray | None
    inliers: np.ndarray
    residual_px: float | None
    covariance: np.ndarray | None


def solve(
    pixels_in_frame: np.ndarray,
    points_in_object: np.ndarray,
    camera: Camera,
    config: PnpConfig | None = None,
    confidence: np.ndarray | None = None,
    seen_from: np.ndarray | None = None,
) -> PnpResult:
    """The camera's pose from pixels (n, 2), distorted as the camera has them, and points (n, 3) in the object.

    confidence (n,), relative to each other, counts in the refinement and not in RANSAC. seen_from (4, 4): the pose of
    the view that gave the points; the further it is from the pose found, the less certain is that. The same input
    gives the same result. Never raises for data that hold no pose: the result says why.
    """
    config = config or PnpConfig()
    if len(pixels_in_frame) < max(config.min_inliers, _MIN_POINTS):
        return _failed("too_few_consistent_points", len(pixels_in_frame))
    plain = camera.undistorted()
    pixels = camera.directions(pixels_in_frame)[:, :2].astype(np.float64) * (plain.fx, plain.fy)
    pixels += (plain.cx, plain.cy)
    points = points_in_object.astype(np.float64)
    threshold = config.threshold_px * max(camera.width, camera.height) / _REFERENCE_SIDE_PX
    start = best_start(pixels, points, plain, threshold, config)
    if start is None:
        return _failed("no_consensus", len(pixels))
    weights = np.ones(len(pixels))
    if confidence is not None:
        weights = np.maximum(confidence.astype(np.float64), _LEAST_CONFIDENCE) ** config.confidence_power
    fit, inliers = _polish(pixels, points, plain, start, weights, threshold, config)
    if fit is None or inliers.sum() < config.min_inlier_ratio * len(pixels):
        return _failed("no_consensus", len(pixels))
    longer_side = max(camera.width, camera.height)
    pose = fit.cam_from_object
    angles = viewing_angles(points[inliers], pose if seen_from is None else seen_from, pose)
    shared = config.shared_error + config.shared_error_by_angle * float(np.median(angles) / inliers.mean())
    covariance = twist_covariance(fit.jacobian, fit.weights, pixels[inliers], longer_side, fit.variance, shared)
    if not _plausible(covariance, pixels[inliers], longer_side, config):
        return _failed("implausible_pose", len(pixels))
    rms = float(np.sqrt((fit.residuals_px**2).sum(axis=1).mean()))
    return PnpResult(True, "ok", pose, inliers, rms, covariance)


def _failed(reason: str, count: int) -> PnpResult:
    return PnpResult(False, reason, None, np.zeros(count, bool), None, None)


def best_start(
    pixels: np.ndarray, points: np.ndarray, camera: Camera, threshold: float, config: PnpConfig
) -> np.ndarray | None:
    """The pose that correspondences agree on best; one that few agree on is compared with those of further runs.

    pixels (n, 2) and points (n, 3) float64, the camera without distortion; None where no run finds a pose.
    """
    best, least = None, np.inf
    for run in range(config.runs):
        pose = _ransac(pixels, points, camera, threshold, config, config.seed + run)
        if pose is None:
            continue
        lengths = np.linalg.norm(reprojection(pixels, points, camera, pose)[0], axis=1)
        cost = float((np.minimum(lengths, threshold) ** 2).sum())
        if cost < least:
            best, least = pose, cost
        if np.count_nonzero(lengths <= threshold) >= config.many_inliers:
            break
    return best


def _ransac(
    pixels: np.ndarray, points: np.ndarray, camera: Camera, threshold: float, config: PnpConfig, seed: int
) -> np.ndarray | None:
    """A pose that many correspondences agree on, or None."""
    params = cv2.UsacParams()
    params.score = cv2.SCORE_METHOD_MSAC
    params.loMethod = cv2.LOCAL_OPTIM_INNER_LO
    params.sampler = cv2.SAMPLING_UNIFORM
    params.final_polisher = cv2.LSQ_POLISHER
    params.threshold, params.confidence = threshold, config.confidence
    params.maxIterations, params.randomGeneratorState = config.iterations, seed
    try:
        found, _, turn, shift, _ = cv2.solvePnPRansac(points, pixels, camera.matrix(), None, params=params)
    except cv2.error:  # its solvers raise for degenerate points
        return None
    if not found or not np.all(np.isfinite(turn)) or not np.all(np.isfinite(shift)):
        return None
    return from_rotation(Rotation.from_rotvec(turn.ravel()), shift.ravel())


def _polish(
    pixels: np.ndarray,
    points: np.ndarray,
    camera: Camera,
    cam_from_object: np.ndarray,
    weights: np.ndarray,
    threshold: float,
    config: PnpConfig,
) -> tuple[PoseFit | None, np.ndarray]:
    """Fit the inliers and choose them anew by the fit, in turn; None where they become too few."""
    pose, fit, inliers = cam_from_object, None, np.zeros(len(pixels), bool)
    for _ in range(_ROUNDS):
        residuals, _ = reprojection(pixels, points, camera, pose)
        agreeing = np.linalg.norm(residuals, axis=1) <= threshold
        if agreeing.sum() < max(config.min_inliers, _MIN_POINTS):
            return None, agreeing
        if fit is not None and np.array_equal(agreeing, inliers):
            break
        inliers = agreeing
        fit = fit_pose(pixels[inliers], points[inliers], camera, pose, weights[inliers])
        pose = fit.cam_from_object
    return fit, inliers


def _plausible(covariance: np.ndarray, inlier_pixels: np.ndarray, longer_side: int, config: PnpConfig) -> bool:
    """Whether the inliers extend over the image and leave the pose certain."""
    spread = np.sqrt(max(np.linalg.eigvalsh(np.cov(inlier_pixels.T))[0], 0.0))
    uncertainty = np.sqrt(max(np.linalg.eigvalsh(covariance[3:, 3:])[-1], 0.0))
    certain = np.isfinite(uncertainty) and np.rad2deg(uncertainty) <= config.max_rotation_std_deg
    return bool(certain and spread >= config.min_spread * longer_side)
