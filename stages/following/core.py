"""The pose of a frame from points of views that exist, found again by their patches; the motion says nearly where.

Points are chosen spread over the frame from the views that saw them most like the frame does; which of them are found
tells how far the pose is to be trusted. Source: Klein and Murray, Parallel tracking and mapping for small AR workspaces
(2007), whose patches are of camera frames where these are of the field, so that nothing drifts.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from cachetools import FIFOCache, LRUCache

from fieldpose.stages.alignment.agreement import covariance_of, fit_agreeing
from fieldpose.stages.alignment.constants import FOUND_PX
from fieldpose.stages.alignment.focal import focal_error
from fieldpose.stages.alignment.images import FramePyramid
from fieldpose.stages.alignment.landmarks import landmarks
from fieldpose.stages.alignment.least_squares import CONVERGED, PoseFit
from fieldpose.stages.alignment.placing import warped
from fieldpose.stages.alignment.views import ViewPoints
from fieldpose.stages.following.choice import Chosen, Found, chosen_points, is_found
from fieldpose.stages.following.config import COARSE_POINTS, KEYFRAMES, LEAST_FOUND, LEVELS, TOGETHER, FollowingConfig
from fieldpose.stages.geometry import Camera, exp_se3, log_se3, twist_covariance, viewing_angles
from fieldpose.stages.geometry.arrays import Covariance, Depth, Flags, Grey, Pixels32, Transform

_LOOSER = 1.4
"""Errors before a round are larger than after the last by this and by how coarse the round is."""
_APART_PX = 4.0
"""Of a level: found points that are shifted otherwise than most by more are not used for the first fit."""
_NEAR_ENOUGH = 1e-3
_GOOD_START = 0.5
"""Of the points: where so many are found from a start, no other is tried."""
_BLURRED = 0.5
"""Where a finer level finds fewer than this share of what the coarser one has, the frame is blurred."""
_FAR_PX = 2.0
"""A pose that puts points so much elsewhere than its start is compared with the one that is found without that."""
_BY_TURN = 0.3
"""What turning the camera on the spot counts, to turning it around what it sees."""
_TYPICAL = 32
"""So many points of a view tell from where it sees them."""


@dataclass(frozen=True)
class Followed:
    """A frame's pose, and what it rests on.

    covariance: (6, 6) of the left twist, as for a single image; noise: the part of it that each frame has anew.
    pixels: (n, 2) of the frame, whose longer side was so long, where points were looked for, at the pose; found: (n,)
    which of them were found.
    focal_error: how much longer the focal length is than said, as a share, with its standard deviation, focal_sigma.
    level: how coarse the images were, 0 for not at all.  angle: typical one, in radians, between the directions from
    which the points are seen in their views and in the frame.
    """

    cam_from_object: Transform
    covariance: Covariance
    noise: Covariance
    longer_side: int
    pixels: Pixels32
    found: Flags
    residual_px: float
    level: int
    angle: float
    focal_error: float
    focal_sigma: float


class Follower:
    """Remembers views and finds their points in frames, which are to be shrunk to the views' size."""

    def __init__(self, config: FollowingConfig) -> None:
        self._config = config
        self._views: LRUCache[str, ViewPoints] = LRUCache(config.views)
        self._keyframes: FIFOCache[str, ViewPoints] = FIFOCache(KEYFRAMES)
        self._kept = 0

    def __contains__(self, view_id: str) -> bool:
        return view_id in self._views or view_id in self._keyframes

    def __len__(self) -> int:
        return len(self._all)

    @property
    def keyframes(self) -> int:
        """How many views were kept so far; the newest KEYFRAMES of them are there, whatever is seen after them."""
        return self._kept

    @property
    def _all(self) -> dict[str, ViewPoints]:
        return {**self._keyframes, **self._views}

    def add(self, view_id: str, grey: Grey, depth: Depth, camera: Camera, cam_from_object: Transform) -> None:
        """Remember a view's points with the most texture; one that is known comes to mind again."""
        if view_id in self._views:
            _ = self._views[view_id]
            return
        points = landmarks(grey, depth, camera, cam_from_object, self._config.landmarks)
        if len(points) >= LEAST_FOUND:
            self._views[view_id] = ViewPoints.of(grey, depth, camera, cam_from_object, points, LEVELS)

    def keep(self, view_id: str) -> None:
        """Keep a view, if it is remembered, however many come after it; beyond KEYFRAMES the oldest of these goes."""
        view = self._views.get(view_id)
        if view is not None:
            self._keyframes[view_id] = view
            self._kept += 1

    def angle(self, cam_from_object: Transform) -> float:
        """How differently, in radians, the nearest view has seen what a camera there sees; infinite without any."""
        return min((difference(view, cam_from_object) for view in self._all.values()), default=np.inf)

    def follow(self, frame: FramePyramid, starts: Iterable[Transform], points: int) -> Followed | None:
        """The frame's pose near one of the poses to start from, the most likely first; None where too few are found.

        points: how many are looked for at most.
        """
        best: tuple[PoseFit, Chosen, Transform] | None = None
        for start in starts:
            chosen = self._chosen(frame, start, points)
            fit = _first_fit(chosen, frame, start)
            if fit is None:
                continue
            if best is None or len(fit.pixels) > len(best[0].pixels):
                best = fit, chosen, start
            if len(fit.pixels) >= _GOOD_START * min(COARSE_POINTS, len(chosen)):
                break
        if best is None:
            return None
        fit, chosen, start = best
        return _better(chosen, frame, _followed(chosen, frame, fit.cam_from_object), start)

    def _chosen(self, frame: FramePyramid, pose: Transform, points: int) -> Chosen:
        nearest = sorted(self._all.values(), key=lambda view: difference(view, pose))[:TOGETHER]
        return chosen_points([(view, warped(view, frame, pose)) for view in nearest], frame, points)


def difference(view: ViewPoints, cam_from_object: Transform) -> float:
    """How differently a camera there sees the view's points: the angle between the directions, in radians, and more.

    Seeing them e times as large counts as much as a radian.
    """
    some = view.points[:: max(1, len(view.points) // _TYPICAL)]
    angle = float(np.median(viewing_angles(some, view.cam_from_object, cam_from_object)))
    there = float(np.median(some @ view.cam_from_object[2, :3])) + view.cam_from_object[2, 3]
    here = float(np.median(some @ cam_from_object[2, :3])) + cam_from_object[2, 3]
    turned = float(np.arccos(np.clip(view.cam_from_object[2, :3] @ cam_from_object[2, :3], -1, 1)))
    return angle + _BY_TURN * turned + (abs(np.log(here / there)) if here > 0 and there > 0 else np.pi)


def _first_fit(chosen: Chosen, frame: FramePyramid, pose: Transform) -> PoseFit | None:
    """The pose at the coarsest level, where most points are shifted alike however far the pose is off."""
    level = LEVELS - 1
    found = chosen.limited(COARSE_POINTS).found(frame, pose, level)
    if len(found) < LEAST_FOUND:
        return None
    shift = found.pixels - found.expected
    alike = np.linalg.norm(shift - np.median(shift, axis=0), axis=1) < _APART_PX * 2**level
    camera = frame.camera.undistorted()
    fit, _ = fit_agreeing(
        found.undistorted[alike], found.points[alike], camera, pose, found.weights[alike], np.inf, LEAST_FOUND,
        _NEAR_ENOUGH,
    )  # fmt: skip
    return None if fit is None else _refitted(found, frame, fit.cam_from_object, level)[0]


def _refitted(found: Found, frame: FramePyramid, pose: Transform, level: int) -> tuple[PoseFit | None, Flags]:
    spread = _LOOSER * FOUND_PX * 2**level if level else FOUND_PX
    return fit_agreeing(
        found.undistorted, found.points, frame.camera.undistorted(), pose, found.weights, spread, LEAST_FOUND,
        _NEAR_ENOUGH if level else CONVERGED,
    )  # fmt: skip


def _better(chosen: Chosen, frame: FramePyramid, found: Followed | None, start: Transform) -> Followed | None:
    """What was found by way of the coarsest level, or without it, which may lead astray where the start was right."""
    if found is not None and chosen.shift(frame, start, found.cam_from_object) < _FAR_PX:
        return found
    direct = _followed(chosen, frame, start)
    if found is None or direct is None:
        return found or direct
    return direct if direct.found.sum() > found.found.sum() else found


def _followed(chosen: Chosen, frame: FramePyramid, pose: Transform) -> Followed | None:
    """From level to level, until the frame, which may be blurred, shows no more."""
    last: tuple[Chosen, PoseFit, Found, Flags, int] | None = None
    for level in range(LEVELS - 2, -1, -1):
        wanted = chosen.limited(COARSE_POINTS * 3 // 2) if level else chosen
        found = wanted.found(frame, pose, level)
        fit, agreeing = _refitted(found, frame, pose, level)
        if fit is None or (last is not None and _share(wanted, fit) < _BLURRED * _share(*last[:2])):
            break
        last, pose = (wanted, fit, found, agreeing, level), fit.cam_from_object
    return None if last is None else _described(frame, *last)


def _share(chosen: Chosen, fit: PoseFit) -> float:
    return len(fit.pixels) / max(len(chosen), 1)


def _described(
    frame: FramePyramid, chosen: Chosen, fit: PoseFit, found: Found, agreeing: Flags, level: int
) -> Followed:  # fmt: skip
    pose, longer_side = fit.cam_from_object, max(frame.camera.width, frame.camera.height)
    pixels, points = chosen.in_frame(frame, pose)
    angle, fitted = chosen.angle(pose), found.pixels[agreeing]
    noise = twist_covariance(fit.errors[1], fit.weights, fitted, longer_side, fit.variance, 0.0)
    rms = float(np.sqrt((fit.errors[0] ** 2).sum(axis=1).mean()))
    return Followed(
        pose, covariance_of(fit, fitted, longer_side, angle), noise, longer_side, pixels.astype(np.float32),
        is_found(found, points, agreeing), rms, level, angle, *focal_error(fit),
    )  # fmt: skip


def warm_up() -> None:
    """Follow a made-up frame, so that kernels are compiled (or fetched from the cache) before the first.

    And have scipy imported, of which the motion between poses is made.
    """
    exp_se3(log_se3(np.eye(4)))
    camera = Camera(64, 64, 64.0, 64.0, 31.5, 31.5)
    grey, depth = np.random.default_rng(0).integers(0, 256, (64, 64), np.uint8), np.full((64, 64), 2.5, np.float32)
    follower = Follower(FollowingConfig())
    follower.add("", grey, depth, camera, np.eye(4))
    follower.follow(FramePyramid.of(grey, camera, 64, LEVELS), [np.eye(4)], 100)
