"""The pose from correspondences between pixels of a frame and points of the object, and how certain it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from fieldpose.bus.messages import Reason
from fieldpose.stages.alignment.agreement import covariance_of
from fieldpose.stages.alignment.landmarks import landmarks
from fieldpose.stages.geometry import Camera, camera_centre, viewing_angles
from fieldpose.stages.geometry.arrays import Covariance, Pixels, Pixels32, Points, Transform, Values
from fieldpose.stages.pnp import constants
from fieldpose.stages.pnp.aligner import Aligner, Pictures
from fieldpose.stages.pnp.background import Contradiction
from fieldpose.stages.pnp.config import PnpConfig
from fieldpose.stages.pnp.consensus import MIN_POINTS, agreed_pose, confirmed_pose

__all__ = ["Pictures", "PnpConfig", "PnpResult", "solve", "warm_up"]

_LEAST_CONFIDENCE = 0.01


@dataclass(frozen=True)
class PnpResult:
    """A pose, what agrees on it, and how certain it is.

    inliers: which of the points given.  inliers_in_frame: their n pixels as matched, or as found in the frame since,
    and there those of landmarks too.  correspondences: how many points these n were among.  residual_px: root mean
    square over the n.  covariance: in the object's unit and radians.
    """

    cam_from_object: Transform
    inliers: Bool[np.ndarray, " given"]
    inliers_in_frame: Pixels32
    correspondences: int
    residual_px: float
    covariance: Covariance


def solve(
    pixels_in_frame: Pixels,
    points_in_object: Points,
    camera: Camera,
    config: PnpConfig | None = None,
    confidence: Values | None = None,
    seen_from: Transform | None = None,
    pictures: Pictures | None = None,
) -> PnpResult | Reason:
    """The camera's pose from pixels, distorted as the camera has them, and points in the object.

    confidence, relative to each other, counts in the refinement and not in RANSAC. pictures: the view that gave
    the points, and the frame; with them all points are looked for anew near where RANSAC's pose puts them, whatever
    they were matched with, and landmarks of the view besides; a pose that the frame's plain background contradicts is
    none. seen_from: where the view was, if there are none; the further it is from the pose found, the less certain is
    that. The same input gives the same result. Data
    that hold no pose give the reason: TOO_FEW_CONSISTENT_POINTS, NO_CONSENSUS or IMPLAUSIBLE_POSE.
    """
    config = config or PnpConfig()
    count, longer_side = len(pixels_in_frame), max(camera.width, camera.height)
    if count < max(config.min_inliers, MIN_POINTS):
        return Reason.TOO_FEW_CONSISTENT_POINTS
    points = points_in_object.astype(np.float64)
    weights = _weights(confidence, count)
    if pictures is None or config.align_levels == 0:
        found = agreed_pose(pixels_in_frame, points, camera, weights, config)
    else:
        seen_from = pictures.cam_from_object
        points = np.concatenate([points, _landmarks(pictures, config.landmarks)])
        aligner = Aligner(pictures, points, camera, config)
        found = confirmed_pose(
            pixels_in_frame, points, camera, weights, aligner, config, Contradiction(pictures, camera)
        )
    if found is None:
        return Reason.NO_CONSENSUS
    fit, pose = found.fit, found.fit.cam_from_object
    angles = viewing_angles(points[found.index], pose if seen_from is None else seen_from, pose)
    covariance = covariance_of(fit, found.pixels, longer_side, float(np.median(angles)))
    distance = float(np.median(np.linalg.norm(points[found.index] - camera_centre(pose), axis=1)))
    if not _plausible(covariance, found.pixels, longer_side, distance, config):
        return Reason.IMPLAUSIBLE_POSE
    inliers, in_frame = np.zeros(count, bool), found.pixels.astype(np.float32)
    inliers[found.index[found.index < count]] = True
    rms = float(np.sqrt((fit.errors[0] ** 2).sum(axis=1).mean()))
    return PnpResult(pose, inliers, in_frame, found.looked_for, rms, covariance)


def _landmarks(pictures: Pictures, most: int) -> np.ndarray:
    return landmarks(pictures.grey, pictures.depth, pictures.camera, pictures.cam_from_object, most)


def warm_up(config: PnpConfig) -> None:
    """Solve a made-up problem, so that kernels are compiled (or fetched from the cache) before the first frame."""
    camera, noise = Camera(64, 64, 64.0, 64.0, 31.5, 31.5), np.random.default_rng(0)
    pixels = noise.uniform(8, 56, (32, 2)).astype(np.float32)
    points = camera.directions(pixels) * noise.uniform(2, 3, (32, 1)).astype(np.float32)
    image, depth = noise.integers(0, 256, (64, 64, 3), np.uint8), np.full((64, 64), 2.5, np.float32)
    solve(pixels, points, camera, config, pictures=Pictures(image, depth, camera, np.eye(4), image))


def _weights(confidence: np.ndarray | None, count: int) -> np.ndarray:
    if confidence is None:
        return np.ones(count)
    return np.maximum(confidence.astype(np.float64), _LEAST_CONFIDENCE) ** constants.CONFIDENCE_POWER


def _plausible(
    covariance: np.ndarray, inlier_pixels: np.ndarray, longer_side: int, distance: float, config: PnpConfig
) -> bool:
    """Whether the inliers, so far from the camera, extend over the image and leave the pose certain."""
    spread = np.sqrt(max(np.linalg.eigvalsh(np.cov(inlier_pixels.T))[0], 0.0))
    shift = np.sqrt(max(np.trace(covariance[:3, :3]), 0.0))
    turn = np.sqrt(max(np.linalg.eigvalsh(covariance[3:, 3:])[-1], 0.0))
    certain = np.rad2deg(turn) <= config.max_rotation_std_deg and shift <= config.max_translation_std * distance
    return bool(certain and spread >= constants.MIN_SPREAD * longer_side)
