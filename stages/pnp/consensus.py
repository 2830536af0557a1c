"""What correspondences agree on: a pose by RANSAC, and what the frame shows at it.

Sources: Fischler and Bolles, Random sample consensus (1981); Chum, Matas and Kittler, Locally optimized RANSAC
(2003), both as PoseLib has them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import poselib
from jaxtyping import Float64

from fieldpose.stages.alignment.agreement import fit_agreeing
from fieldpose.stages.alignment.least_squares import CONVERGED, PoseFit, isotropic
from fieldpose.stages.geometry import Camera, is_rigid
from fieldpose.stages.geometry.arrays import Indices, Pixels, Pixels64, Points64, Transform, Values
from fieldpose.stages.pnp import constants
from fieldpose.stages.pnp.aligner import Aligner
from fieldpose.stages.pnp.config import PnpConfig

MIN_POINTS = 4
_NEAR_ENOUGH = 1e-3
_ENOUGH = 300
"""So many points are enough to come nearer; all of them are looked for at the end."""
_LEAST_ALIGNED = 0.3
"""Of the matches that agreed; where fewer points are found, the frame is blurred, say, and the matches know better."""
_LEAST_IN_FRAME = 1 / 3
"""Of the landmarks: so many count as looked for even where a pose, maybe a wrong one, leaves fewer in the frame."""
_FEWER_ITERATIONS = 1000
"""Of RANSAC, where a pose is known already and only a better one is looked for."""
_REFERENCE_SIDE_PX = 400


@dataclass(frozen=True)
class Consensus:
    """A pose and what agrees on it: `index` of the points, their pixels in the frame, distorted.

    The first `matched` points are the matches', the others landmarks, of which `marks` were looked for.
    """

    fit: PoseFit
    index: Indices
    pixels: Pixels
    matched: int
    marks: int

    @property
    def looked_for(self) -> int:
        """How many points might have agreed."""
        return self.matched + self.marks

    @property
    def of_matched(self) -> int:
        """How many matches agree."""
        return int((self.index < self.matched).sum())

    @property
    def landmarks(self) -> int:
        """How many landmarks agree."""
        return len(self.index) - self.of_matched


def agreed_pose(
    pixels_in_frame: Pixels, points: Points64, camera: Camera, weights: Values, config: PnpConfig
) -> Consensus | None:
    """The pose that most matches agree on, fitted to these; None where too few do.

    Pixels are distorted as the camera has them, where those without an inverse agree on nothing.
    """
    pixels, usable = camera.without_distortion(pixels_in_frame)
    index, plain = np.flatnonzero(usable), camera.undistorted()
    if len(index) < MIN_POINTS:
        return None
    pixels, matrices = pixels[index], isotropic(weights[index])
    threshold = config.threshold_px * max(camera.width, camera.height) / _REFERENCE_SIDE_PX
    start = _ransac(pixels, points[index], plain, threshold, config)
    if start is None:
        return None
    fit, inliers = fit_agreeing(pixels, points[index], plain, start, matrices, threshold, _least(config))
    if fit is None or inliers.sum() < config.min_inlier_ratio * len(points):
        return None
    index = index[inliers]
    return Consensus(fit, index, pixels_in_frame[index], len(points), 0)


def confirmed_pose(
    pixels_in_frame: Pixels,
    points: Float64[np.ndarray, "all_points 3"],
    camera: Camera,
    weights: Values,
    aligner: Aligner,
    config: PnpConfig,
    contradicted: Callable[[Transform], bool],
) -> Consensus | None:
    """Of the poses that matches agree on, the one at which the most points are found in the frame.

    points: those of the matches, whose pixels and weights are given, then landmarks, which no match has chosen. The
    first pose is it if many landmarks are found. If not, the matches that agreed so far are left out, for others to
    agree on another pose, as they do where the object has parts that look alike. If too little is found at each, it is
    the first after all, if enough matches agree on it, else None. A pose that is contradicted is none of these.
    """
    count = len(pixels_in_frame)
    marks = len(points) - count
    search = replace(config, min_inlier_ratio=config.min_inlier_ratio * constants.UNCONFIRMED_SHARE)
    left, best, first, most, needed = np.arange(count), None, None, 0, 0.0
    attempts, contradictions = 0, 0
    while attempts < constants.ATTEMPTS and contradictions < constants.CONTRADICTIONS:
        agreed = agreed_pose(pixels_in_frame[left], points[left], camera, weights[left], search)
        if agreed is None:
            break
        agreed, left = (
            replace(agreed, index=left[agreed.index], matched=count, marks=marks), np.delete(left, agreed.index),
        )  # fmt: skip
        found, most = _aligned(agreed, aligner, points, camera, config), max(most, agreed.of_matched)
        if found is not None and (
            found.of_matched < _LEAST_ALIGNED * most or found.landmarks < constants.MIN_LANDMARKS * found.marks
        ):
            found = None
        if contradicted((agreed if found is None else found).fit.cam_from_object):
            contradictions += 1
            continue
        attempts += 1
        if found is not None and found.of_matched >= constants.MIN_SUPPORT * count:
            if best is None or len(found.index) > len(best.index):
                best = found
            if found.landmarks >= constants.SURE_LANDMARKS * found.marks:
                break
            search = replace(search, iterations=min(search.iterations, _FEWER_ITERATIONS))
        elif first is None:
            first, share = (agreed, constants.MIN_UNALIGNED) if found is None else (found, config.min_inlier_ratio)
            needed = share * count
    if best is not None:
        return best
    return first if first is not None and first.of_matched >= needed else None


def _aligned(
    agreed: Consensus, aligner: Aligner, points: np.ndarray, camera: Camera, config: PnpConfig
) -> Consensus | None:
    """The pose by where points are found in the frame, from round to round; None where too few are, or by chance."""
    found, rounds = agreed, list(aligner.rounds())
    for i, (level, spread_px) in enumerate(rounds):
        last = i == len(rounds) - 1
        placed = aligner.place(found.fit.cam_from_object, level, None if last else _ENOUGH)
        pixels, usable = camera.without_distortion(placed.pixels)  # a search may end where the lens has no inverse
        index, pixels = placed.index[usable], pixels[usable]
        fit, inliers = fit_agreeing(
            pixels, points[index], camera.undistorted(), found.fit.cam_from_object, placed.weights[usable], spread_px,
            _least(config), CONVERGED if last else _NEAR_ENOUGH,
        )  # fmt: skip
        if fit is None:
            return None
        in_frame = max(int(placed.seen[agreed.matched :].sum()), int(_LEAST_IN_FRAME * agreed.marks))
        found = Consensus(fit, index[inliers], placed.pixels[usable][inliers], agreed.matched, in_frame)
    rms = float(np.sqrt((found.fit.errors[0] ** 2).sum(axis=1).mean()))
    return found if rms <= constants.ALIGN_SPREAD * rounds[-1][1] else None


def _least(config: PnpConfig) -> int:
    return max(config.min_inliers, MIN_POINTS)


def _ransac(
    pixels: Pixels64, points: Points64, camera: Camera, threshold: float, config: PnpConfig
) -> Transform | None:
    """The pose that most correspondences agree on, or None; the camera is without distortion."""
    model = {"model": "PINHOLE", "width": camera.width, "height": camera.height}
    intrinsics = [camera.fx, camera.fy, camera.cx, camera.cy]
    options = {
        "max_reproj_error": threshold, "max_iterations": config.iterations,
        "min_iterations": constants.LEAST_ITERATIONS, "success_prob": constants.CONFIDENCE, "seed": config.seed,
    }  # fmt: skip
    found, about = poselib.estimate_absolute_pose(
        pixels, points, {**model, "params": intrinsics}, ransac_opt=options, bundle_opt={"max_iterations": 0}
    )
    pose = np.eye(4)
    pose[:3] = found.Rt
    return pose if about["num_inliers"] >= MIN_POINTS and is_rigid(pose) else None
