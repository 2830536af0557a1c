"""How good a pose is, from what the solver says about it, and whether it is to be believed."""

from __future__ import annotations

import numpy as np

from fieldpose.stages.tracking.config import ScoreConfig, TrackingConfig
from fieldpose.stages.tracking.policy import PoseResult


def score(result: PoseResult, config: ScoreConfig, scale: float = 1.0) -> float:
    """0 (no pose, or one not to be used) to 1 (nothing to complain of): the weakest of its measures."""
    if result.cam_from_object is None or result.inliers < config.min_inliers:
        return 0.0
    measures = [
        result.inliers / max(config.good_inliers, 1),
        result.inliers / max(result.correspondences, 1) / max(config.good_inlier_ratio, 1e-9),
    ]
    if result.residual_px is not None:
        measures.append(_share(config.good_residual_px, result.residual_px))
    if result.covariance is not None:
        sigma, sigma_deg = deviations(result.covariance)
        good = config.good_sigma.scaled(scale)
        measures += [_share(good.distance, sigma), _share(good.angle_deg, sigma_deg)]
    return float(np.clip(min(measures), 0.0, 1.0))


def believed(result: PoseResult, guess: np.ndarray, config: TrackingConfig, scale: float = 1.0) -> bool:
    """Whether the pose of an image that stands by itself is believed.

    It is if it scores high, or if it lies where its pass began (`guess`) and scores well: from there most points of a
    right pose are found, while a wrong one has few inliers, and seldom leads to itself.
    """
    quality, pose = score(result, config.score, scale), result.cam_from_object
    if pose is None or quality < config.score.good:
        return False
    settled = config.settled.scaled(scale)
    return quality >= config.score.sure or settled.holds(guess, pose)


def deviations(covariance: np.ndarray) -> tuple[float, float]:
    """Standard deviations of translation (field units) and rotation (degrees) of a (6, 6) twist covariance."""
    variances = np.maximum(np.diag(covariance), 0.0)
    return float(np.sqrt(variances[:3].sum())), float(np.rad2deg(np.sqrt(variances[3:].sum())))


def _share(good: float, value: float) -> float:
    return good / value if value > good else 1.0
