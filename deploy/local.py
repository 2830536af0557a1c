"""One image through the cores of the stages, in this process and without a bus."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import TypeVar

import numpy as np

from fieldpose.bus.messages import GuessReason, Reason
from fieldpose.deploy.lookalikes import Lookalikes
from fieldpose.deploy.settings import Settings
from fieldpose.stages.geometry import Camera
from fieldpose.stages.lifting.core import ConsistencyMemory, Lifted, lift
from fieldpose.stages.matching.core import PairMatcher, build_matcher
from fieldpose.stages.nerf.rendering_api import RayRenderer
from fieldpose.stages.pnp.core import Pictures, PnpResult, solve
from fieldpose.stages.refinement.core import RefinementResult, refine
from fieldpose.stages.rendering.core import SourcedView, ViewSource
from fieldpose.stages.tracking.frame_policies import EachFramePolicy
from fieldpose.stages.tracking.policy import Attempt, Belief, FrameInfo, PoseGuess, PoseResult
from fieldpose.stages.tracking.views import TrainingViews

T = TypeVar("T")

_FRAME = FrameInfo(frame_id=0, capture_ns=0)


@dataclass
class PoseFound:
    """The answer for one image: `reason` says why there is no pose; stage_ms is of the pass that counts."""

    reason: Reason
    cam_from_object: np.ndarray | None = None
    covariance: np.ndarray | None = None
    inliers: int = 0
    correspondences: int = 0
    residual_px: float | None = None
    refined: bool = False
    loss_before: float | None = None
    loss_after: float | None = None
    passes: int = 1
    stage_ms: dict[str, float] = field(default_factory=dict)

    @property
    def ok(self) -> bool:
        """Whether a pose was found."""
        return self.cam_from_object is not None


class PoseFinder:
    """Renders, matches, lifts, solves and refines, again and from elsewhere until a pose is believed.

    `views` are the field's training views. Raises ConfigError and WeightsError.
    """

    def __init__(self, renderer: RayRenderer, settings: Settings, views: TrainingViews) -> None:
        self._renderer, self._settings, self._training_views = renderer, settings, views
        self._views = ViewSource(renderer, settings.rendering)
        self._matcher = PairMatcher(build_matcher(settings.matching), settings.matching)
        self._lookalikes = Lookalikes(views, settings, self._matcher)
        self._consistency = ConsistencyMemory(len(views.names))
        self._images = 0

    def prepare(self, camera: Camera) -> None:
        """Render all training views for a camera and keep what is needed of them, as far as the settings let it.

        An image that is then found from one of them takes a third of the time.
        """
        rng = np.random.default_rng(self._settings.tracking.seed)
        for pose in self._training_views.cam_from_object:
            sourced = self._views.view(camera, pose)
            features = self._matcher.view_features(sourced.view.rgb, sourced.view.opacity, sourced.view_id)
            self._lift(sourced, features.pixels, rng)

    def find(self, image: np.ndarray, camera: Camera, guess: np.ndarray | None = None) -> PoseFound:
        """The pose of an image (h, w, 3) uint8 from a guessed cam_from_object (4, 4); see EachFramePolicy.

        Without a guess it is found from the training views that look like the image; none if the field does not know
        how they look.
        """
        self._images += 1
        clock = _Clock()

        @cache
        def alike(frame: FrameInfo) -> list[np.ndarray]:
            return clock.time("retrieval", lambda: self._lookalikes.of(image, camera, self._images, guess is None))

        if guess is None:
            likely = alike(_FRAME)
            if not likely:
                return PoseFound(Reason.NOTHING_ALIKE, stage_ms=clock.ms)
            guess = likely[0]
        policy = EachFramePolicy(self._settings.tracking, self._training_views, {_FRAME.frame_id: guess}, alike)
        rng = np.random.default_rng(self._settings.tracking.seed)
        attempt = Attempt(_FRAME, PoseGuess(GuessReason.PRIOR, guess), sent_ns=0)
        further, tried = policy.first_guess(_FRAME), list[PoseFound]()
        while further is not None:
            tried.append(self._one_pass(image, camera, further, rng))
            result = _result(tried[-1], attempt.pass_index)
            further = policy.next_guess(attempt, result)
            if further is not None:
                attempt = attempt.again(further, now_ns=0)
        found = _concluded(tried, policy.conclude(attempt, result))
        return replace(found, stage_ms={**clock.ms, **found.stage_ms})

    def _one_pass(self, image: np.ndarray, camera: Camera, guess: PoseGuess, rng: np.random.Generator) -> PoseFound:
        """One way through the stages."""
        clock, next_pass = _Clock(), guess.reason is GuessReason.NEXT_PASS
        sourced = clock.time("rendering", lambda: self._views.view(camera, guess.cam_from_object, next_pass))
        if sourced.visible < self._settings.rendering.min_visible:
            return PoseFound(Reason.NOTHING_IN_VIEW, stage_ms=clock.ms)
        view = sourced.view
        matched = clock.time(
            "matching", lambda: self._matcher.match(view.rgb, view.opacity, image, sourced.view_id, self._images)
        )
        if len(matched.confidence) < self._settings.matching.min_matches:
            return PoseFound(Reason.TOO_FEW_MATCHES, stage_ms=clock.ms)
        lifted = clock.time("lifting", lambda: self._lift(sourced, matched.pixels_a, rng))
        kept = lifted.kept
        if kept.sum() < self._settings.lifting.min_kept:
            return PoseFound(Reason.TOO_FEW_CONSISTENT_POINTS, stage_ms=clock.ms)
        pixels, points, confidence = matched.pixels_b[kept], lifted.points_in_object[kept], matched.confidence[kept]
        seen_from = view.cam_from_object
        pictures = Pictures(view.rgb, view.depth, view.camera, seen_from, image)
        solved = clock.time(
            "pnp", lambda: solve(pixels, points, camera, self._settings.pnp, confidence, seen_from, pictures)
        )
        if solved.cam_from_object is None:
            return PoseFound(Reason(solved.reason), correspondences=solved.correspondences, stage_ms=clock.ms)
        pose = solved.cam_from_object
        refined = clock.time(
            "refinement",
            lambda: refine(
                self._renderer, image, camera, pose, solved.inliers_in_frame, rng, self._settings.refinement
            ),
        )
        return _found(solved, refined, clock.ms)

    def _lift(self, sourced: SourcedView, pixels: np.ndarray, rng: np.random.Generator) -> Lifted:
        view = sourced.view
        return lift(
            self._renderer, view.depth, view.opacity, view.camera, view.cam_from_object, pixels, rng,
            self._settings.lifting, self._consistency.of(sourced.view_id),
        )  # fmt: skip


def _result(found: PoseFound, pass_index: int) -> PoseResult:
    return PoseResult(
        _FRAME.frame_id, pass_index, found.ok, found.cam_from_object, found.covariance, found.inliers,
        found.correspondences, found.residual_px,
    )  # fmt: skip


def _concluded(tried: Sequence[PoseFound], belief: Belief) -> PoseFound:
    """The one of the passes' results that is believed, else why the first guess has led to none."""
    first = tried[0]
    for found in reversed(tried):
        if found.ok and found.cam_from_object is belief.cam_from_object:
            return replace(found, covariance=belief.covariance, passes=len(tried))
    reason = Reason.IMPLAUSIBLE_POSE if first.ok else first.reason
    return PoseFound(reason, correspondences=first.correspondences, passes=len(tried), stage_ms=first.stage_ms)


class _Clock:
    def __init__(self) -> None:
        self.ms: dict[str, float] = {}

    def time(self, name: str, work: Callable[[], T]) -> T:
        began = time.perf_counter()
        result = work()
        self.ms[name] = (time.perf_counter() - began) * 1e3
        return result


def _found(solved: PnpResult, refined: RefinementResult, ms: dict[str, float]) -> PoseFound:
    return PoseFound(
        reason=Reason.OK,
        cam_from_object=refined.cam_from_object,
        covariance=solved.covariance if refined.covariance is None else refined.covariance,
        inliers=len(solved.inliers_in_frame),
        correspondences=solved.correspondences,
        residual_px=solved.residual_px,
        refined=refined.refined,
        loss_before=refined.loss_before,
        loss_after=refined.loss_after,
        stage_ms=ms,
    )
