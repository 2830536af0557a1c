"""The pose from correspondences between pixels of a frame and points of the object: RANSAC, refinement, checks.

Sources: Fischler and Bolles, Random sample consensus (1981); Chum, Matas and Kittler, Locally optimized RANSAC
(2003), both as PoseLib has them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import poselib

from stages.errors import StageError
from stages.geometry import Camera, camera_centre, is_rigid, twist_covariance, viewing_angles
from stages.pnp.alignment import Aligner, Pictures
from stages.pnp.config import PnpConfig
from stages.pnp.landmarks import landmarks
from stages.pnp.least_squares import CONVERGED, PoseFit, alike_in_all_directions, distances_px, fit_pose

__all__ = ["Pictures", "PnpConfig", "PnpResult", "solve", "warm_up"]

_MIN_POINTS = 4
_ROUNDS = 3
_NEAR_ENOUGH = 1e-3
_ENOUGH = 300
"""So many points are enough to come nearer; all of them are looked for at the end."""
_LEAST_ALIGNED = 0.3
"""Of the matches that agreed; where fewer points are found, the frame is blurred, say, and the matches know better."""
_FEWER_ITERATIONS = 1000
"""Of RANSAC, where a pose is known already and only a better one is looked for."""
_LEAST_CONFIDENCE = 0.01
_REFERENCE_SIDE_PX = 400


@dataclass(frozen=True)
class PnpResult:
    """ok and a reason that is a value of bus.messages.Reason; the rest is None, or nothing, where not ok.

    inliers: (n,) bool, of the points given.  inliers_in_frame: (m, 2) float32, their pixels as matched, or as found in
    the frame since, and there those of landmarks too.  correspondences: how many points these m were among.
    residual_px: root mean square over the m.  covariance: (6, 6) of the left twist (translation, rotation) of
    cam_from_object, in the object's unit and radians.
    """

    ok: bool
    reason: str
    cam_from_object: np.ndarray | None
    inliers: np.ndarray
    inliers_in_frame: np.ndarray
    correspondences: int
    residual_px: float | None
    covariance: np.ndarray | None


@dataclass(frozen=True)
class _Consensus:
    """A pose and what agrees on it: `index` (m,) of the `looked_for` points, their pixels (m, 2) in the frame.

    The first `matched` points are the correspondences', the others landmarks.
    """

    fit: PoseFit
    index: np.ndarray
    pixels: np.ndarray
    matched: int
    looked_for: int

    @property
    def of_matched(self) -> int:
        """How many correspondences agree."""
        return int((self.index < self.matched).sum())

    @property
    def landmarks(self) -> int:
        """How many landmarks agree."""
        return len(self.index) - self.of_matched


def solve(
    pixels_in_frame: np.ndarray,
    points_in_object: np.ndarray,
    camera: Camera,
    config: PnpConfig | None = None,
    confidence: np.ndarray | None = None,
    seen_from: np.ndarray | None = None,
    pictures: Pictures | None = None,
) -> PnpResult:
    """The camera's pose from pixels (n, 2), distorted as the camera has them, and points (n, 3) in the object.

    confidence (n,), relative to each other, counts in the refinement and not in RANSAC. pictures: the view that gave
    the points, and the frame; with them all points are looked for anew near where RANSAC's pose puts them, whatever
    they were matched with, and landmarks of the view besides. seen_from (4, 4): where the view was, if there are none;
    the further it is from the pose found, the less certain is that. The same input gives the same result. Never raises
    for data that hold no pose: the result says why.
    """
    config = config or PnpConfig()
    count, longer_side = len(pixels_in_frame), max(camera.width, camera.height)
    if count < max(config.min_inliers, _MIN_POINTS):
        return _failed("too_few_consistent_points", count)
    points = points_in_object.astype(np.float64)
    weights = _weights(confidence, count, config)
    if pictures is None or config.align_levels == 0:
        found = _agreed(pixels_in_frame, points, camera, weights, config)
    else:
        seen_from = pictures.cam_from_object
        points = np.concatenate([points, landmarks(pictures, config.landmarks)])
        aligner = Aligner(pictures, points, camera, config)
        found = _confirmed(pixels_in_frame, points, camera, weights, aligner, config)
    if found is None:
        return _failed("no_consensus", count)
    fit, pose = found.fit, found.fit.cam_from_object
    angles = viewing_angles(points[found.index], pose if seen_from is None else seen_from, pose)
    shared = config.shared_error + config.shared_error_by_angle * float(np.median(angles))
    residuals, jacobian = fit.errors
    covariance = twist_covariance(
        jacobian, fit.weights, found.pixels, longer_side, fit.variance, shared**2 * fit.variance_px
    )
    distance = float(np.median(np.linalg.norm(points[found.index] - camera_centre(pose), axis=1)))
    if not _plausible(covariance, found.pixels, longer_side, distance, config):
        return _failed("implausible_pose", count)
    inliers, in_frame = np.zeros(count, bool), found.pixels.astype(np.float32)
    inliers[found.index[found.index < count]] = True
    rms = float(np.sqrt((residuals**2).sum(axis=1).mean()))
    return PnpResult(True, "ok", pose, inliers, in_frame, found.looked_for, rms, covariance)


def warm_up(config: PnpConfig) -> None:
    """Solve a made-up problem, so that kernels are compiled (or fetched from the cache) before the first frame."""
    camera, noise = Camera(64, 64, 64.0, 64.0, 31.5, 31.5), np.random.default_rng(0)
    pixels = noise.uniform(8, 56, (32, 2)).astype(np.float32)
    points = camera.directions(pixels) * noise.uniform(2, 3, (32, 1)).astype(np.float32)
    image, depth = noise.integers(0, 256, (64, 64, 3), np.uint8), np.full((64, 64), 2.5, np.float32)
    solve(pixels, points, camera, config, pictures=Pictures(image, depth, camera, np.eye(4), image))


def _failed(reason: str, count: int) -> PnpResult:
    return PnpResult(False, reason, None, np.zeros(count, bool), np.zeros((0, 2), np.float32), count, None, None)


def _weights(confidence: np.ndarray | None, count: int, config: PnpConfig) -> np.ndarray:
    if confidence is None:
        return np.ones(count)
    return np.maximum(confidence.astype(np.float64), _LEAST_CONFIDENCE) ** config.confidence_power


def _agreed(
    pixels_in_frame: np.ndarray, points: np.ndarray, camera: Camera, weights: np.ndarray, config: PnpConfig
) -> _Consensus | None:
    """The pose that most matches agree on, fitted to these; None where too few do."""
    if len(points) < _MIN_POINTS:
        return None
    pixels, plain = _ideal(pixels_in_frame, camera), camera.undistorted()
    threshold = config.threshold_px * max(camera.width, camera.height) / _REFERENCE_SIDE_PX
    start = best_start(pixels, points, plain, threshold, config)
    if start is None:
        return None
    fit, inliers = _polish(pixels, points, plain, start, alike_in_all_directions(weights), threshold, config)
    if fit is None or inliers.sum() < config.min_inlier_ratio * len(pixels):
        return None
    return _Consensus(fit, np.flatnonzero(inliers), pixels_in_frame[inliers], len(points), len(points))


def _confirmed(
    pixels_in_frame: np.ndarray, points: np.ndarray, camera: Camera, weights: np.ndarray, aligner: Aligner,
    config: PnpConfig,
) -> _Consensus | None:
    """Of the poses that matches agree on, the one at which the most points are found in the frame.

    points: those of the matches, then landmarks, which no match has chosen. The first pose is it if many landmarks are
    found. If not, the matches that agreed so far are left out, for others to agree on another pose, as they do where
    the object has parts that look alike. If too little is found at any, it is the first after all.
    """
    count = len(pixels_in_frame)
    marks = len(points) - count
    search = replace(config, min_inlier_ratio=config.min_inlier_ratio * config.unconfirmed_share)
    left, best, first, most, needed = np.arange(count), None, None, 0, 0.0
    for _ in range(config.attempts):
        agreed = _agreed(pixels_in_frame[left], points[left], camera, weights[left], search)
        if agreed is None:
            break
        others = np.delete(left, agreed.index)
        agreed = replace(agreed, index=left[agreed.index], matched=count, looked_for=count)
        found, most = _aligned(agreed, aligner, points, camera, config), max(most, agreed.of_matched)
        if found is not None and not (
            found.of_matched >= _LEAST_ALIGNED * most and found.landmarks >= int(config.min_landmarks * marks)
        ):
            found = None
        if found is not None and found.of_matched >= config.min_support * count:
            if best is None or len(found.index) > len(best.index):
                best = found
            if found.landmarks >= config.sure_landmarks * marks:
                break
            search = replace(search, iterations=min(search.iterations, _FEWER_ITERATIONS))
        elif first is None:
            first, share = (agreed, config.min_unaligned) if found is None else (found, config.min_inlier_ratio)
            needed = share * count
        left = others
    if best is not None:
        return best
    return first if first is not None and first.of_matched >= needed else None


def _aligned(
    agreed: _Consensus, aligner: Aligner, points: np.ndarray, camera: Camera, config: PnpConfig
) -> _Consensus | None:
    """The pose by where points are found in the frame, from round to round; None where too few are, or by chance."""
    found, rounds = agreed, list(aligner.rounds())
    for i, (level, spread_px) in enumerate(rounds):
        last = i == len(rounds) - 1
        placed = aligner.place(found.fit.cam_from_object, level, None if last else _ENOUGH)
        try:
            pixels = _ideal(placed.pixels, camera)
        except StageError:  # a point was found where the lens has no inverse
            return None
        fit, inliers = _polish(
            pixels, points[placed.index], camera.undistorted(), found.fit.cam_from_object, placed.weights, spread_px,
            config, CONVERGED if last else _NEAR_ENOUGH,
        )  # fmt: skip
        if fit is None:
            return None
        found = _Consensus(fit, placed.index[inliers], placed.pixels[inliers], agreed.matched, len(points))
    rms = float(np.sqrt((found.fit.errors[0] ** 2).sum(axis=1).mean()))
    return found if rms <= config.align_spread * rounds[-1][1] else None


def _ideal(pixels: np.ndarray, camera: Camera) -> np.ndarray:
    """Pixels (n, 2) float64 of the camera without distortion."""
    return camera.directions(pixels)[:, :2].astype(np.float64) * (camera.fx, camera.fy) + (camera.cx, camera.cy)


def best_start(
    pixels: np.ndarray, points: np.ndarray, camera: Camera, threshold: float, config: PnpConfig
) -> np.ndarray | None:
    """The pose that most correspondences agree on, or None.

    pixels (n, 2) and points (n, 3) float64, the camera without distortion.
    """
    model = {"model": "PINHOLE", "width": camera.width, "height": camera.height}
    intrinsics = [camera.fx, camera.fy, camera.cx, camera.cy]
    options = {
        "max_reproj_error": threshold, "max_iterations": config.iterations,
        "min_iterations": config.least_iterations, "success_prob": config.confidence, "seed": config.seed,
    }  # fmt: skip
    found, about = poselib.estimate_absolute_pose(
        pixels, points, {**model, "params": intrinsics}, ransac_opt=options, bundle_opt={"max_iterations": 0}
    )
    pose = np.eye(4)
    pose[:3] = found.Rt
    return pose if about["num_inliers"] >= _MIN_POINTS and is_rigid(pose) else None


def _polish(
    pixels: np.ndarray,
    points: np.ndarray,
    camera: Camera,
    cam_from_object: np.ndarray,
    weights: np.ndarray,
    threshold: float,
    config: PnpConfig,
    converged: float = CONVERGED,
) -> tuple[PoseFit | None, np.ndarray]:
    """Fit the inliers and choose them anew by the fit, in turn; None where they become too few."""
    pose, fit, inliers = cam_from_object, None, np.zeros(len(pixels), bool)
    for _ in range(_ROUNDS):
        agreeing = distances_px(pixels, points, camera, pose) <= threshold
        if agreeing.sum() < max(config.min_inliers, _MIN_POINTS):
            return None, agreeing
        if fit is not None and np.array_equal(agreeing, inliers):
            break
        inliers = agreeing
        fit = fit_pose(pixels[inliers], points[inliers], camera, pose, weights[inliers], converged)
        pose = fit.cam_from_object
    return fit, inliers


def _plausible(
    covariance: np.ndarray, inlier_pixels: np.ndarray, longer_side: int, distance: float, config: PnpConfig
) -> bool:
    """Whether the inliers, so far from the camera, extend over the image and leave the pose certain."""
    spread = np.sqrt(max(np.linalg.eigvalsh(np.cov(inlier_pixels.T))[0], 0.0))
    shift = np.sqrt(max(np.trace(covariance[:3, :3]), 0.0))
    turn = np.sqrt(max(np.linalg.eigvalsh(covariance[3:, 3:])[-1], 0.0))
    certain = np.rad2deg(turn) <= config.max_rotation_std_deg and shift <= config.max_translation_std * distance
    return bool(certain and spread >= config.min_spread * longer_side)
