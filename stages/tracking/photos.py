"""Photos: each stands by itself, and no frame learns from another."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from fieldpose.bus.messages import GuessReason, Reason, TrackingState
from fieldpose.stages.geometry import Limit
from fieldpose.stages.nerf.training_views import TrainingViews
from fieldpose.stages.tracking.certainty import Certainty
from fieldpose.stages.tracking.config import COVER, TrackingConfig
from fieldpose.stages.tracking.policy import Alike, Attempt, Belief, FrameInfo, Look, PoseGuess, PoseResult, Step
from fieldpose.stages.tracking.priors import Priors
from fieldpose.stages.tracking.scoring import believed, score
from fieldpose.stages.tracking.search import farthest_point_order, nearest_first

_HOPELESS = (Reason.FRAME_UNREADABLE, Reason.FRAME_MISSING)
"""Reasons for which no other guess can help."""


@dataclass
class _Trial:
    """A frame in flight: the poses tried, its guess first; what is believed so far; why the first pass failed.

    alike: training views that look like it, and further: those to try then, in order; None until they are asked for.
    """

    tried: list[np.ndarray] = field(default_factory=list)
    found: Belief | None = None
    reason: Reason | None = None
    alike: Sequence[np.ndarray] | None = None
    further: Sequence[np.ndarray] | None = None


class PhotoPolicy:
    """Begins with the frame's prior or with `start`, else with the training view that looks most like the frame.

    Each pass begins where the pass before ended. Where that leads to no pose that is believed, training views are
    tried: those that look like the frame, then those nearest to the guess. A pose that is not believed is none; with a
    single pass there is nothing to confirm it by, and every usable one counts. `looks`: whether retrieval can be asked.
    """

    def __init__(
        self, config: TrackingConfig, views: TrainingViews, priors: Priors, start: np.ndarray | None = None,
        looks: bool = True,
    ) -> None:  # fmt: skip
        self._config, self._views, self._priors, self._start, self._looks = config, views, priors, start, looks
        self._scale = views.scale
        self._certainty = Certainty(views.error_scale, self._scale)
        self._settled = config.settled.scaled(self._scale)
        self._cover = COVER.scaled(self._scale)
        self._trials: dict[int, _Trial] = {}

    def on_prior(self, frame_id: int, cam_from_object: np.ndarray) -> None:
        """Keep it for its frame."""
        self._priors.add(frame_id, cam_from_object)

    def first_step(self, frame: FrameInfo) -> Step | None:
        """PRIOR, or a Look where there is no guess; None for a frame whose prior is awaited."""
        prior = self._priors.take(frame.frame_id)
        if prior is None and self._priors.awaited:
            return None
        trial = self._trials[frame.frame_id] = _Trial()
        guess = self._start if prior is None else prior
        if guess is not None:
            trial.tried.append(guess)
            return PoseGuess(GuessReason.PRIOR, guess)
        return Look() if self._looks else self._untried(trial)

    def after_look(self, attempt: Attempt, alike: Alike) -> PoseGuess | None:
        """RELOCALISATION; None where nothing looks like the frame and there was no guess to begin with."""
        trial = self._trials[attempt.frame.frame_id]
        trial.alike = alike.poses
        if alike.reason in _HOPELESS or (not trial.tried and alike.reason is Reason.NOTHING_ALIKE):
            return None
        return self._untried(trial)

    def next_step(self, attempt: Attempt, result: PoseResult) -> Step | None:
        """NEXT_PASS until the pose settles or the passes are used up; then a search unless one is believed."""
        trial, pose = self._trials[attempt.frame.frame_id], result.cam_from_object
        trial.reason = trial.reason or result.reason or Reason.IMPLAUSIBLE_POSE
        if pose is not None and attempt.guess is not None and self._quality(result) >= self._config.score.usable:
            trial.found = self._belief(attempt, result) or trial.found
            settled = self._settled.holds(attempt.guess.cam_from_object, pose)
            if attempt.passes < self._config.passes and not settled:
                return PoseGuess(GuessReason.NEXT_PASS, pose)
        if result.reason in _HOPELESS:
            return None
        if self._config.passes == 1 or trial.found is not None or len(trial.tried) > self._config.searches:
            return None
        return Look() if self._looks and trial.alike is None else self._untried(trial)

    def conclude(self, attempt: Attempt, result: PoseResult) -> Belief:
        """The newest pose that was believed, TRACKING; LOST without one."""
        trial = self._trials.pop(attempt.frame.frame_id)
        reason = trial.reason or result.reason
        return self._belief(attempt, result) or trial.found or Belief(TrackingState.LOST, 0.0, reason=reason)

    def missed(self, frame: FrameInfo, reason: Reason) -> Belief:
        """Of a frame that did not come back, what was believed before."""
        trial = self._trials.pop(frame.frame_id, None)
        if trial is not None and trial.found is not None:
            return trial.found
        return Belief(TrackingState.LOST, 0.0, reason=reason)

    def _quality(self, result: PoseResult) -> float:
        return score(result, self._config.score, self._scale)

    def _belief(self, attempt: Attempt, result: PoseResult) -> Belief | None:
        """TRACKING at the pose that was found; None if it is not believed."""
        pose = result.cam_from_object
        if pose is None or attempt.guess is None or not self._believes(attempt.guess.cam_from_object, result):
            return None
        covariance = self._certainty.of(result.covariance, attempt.guess.cam_from_object, pose)
        return Belief(TrackingState.TRACKING, self._quality(result), pose, covariance)

    def _believes(self, guess: np.ndarray, result: PoseResult) -> bool:
        if self._config.passes == 1:
            return self._quality(result) >= self._config.score.usable
        return believed(result, guess, self._config, self._scale)

    def _untried(self, trial: _Trial) -> PoseGuess | None:
        """The next training view to try; None when as many have been as may be."""
        if len(trial.tried) > self._config.searches:
            return None
        pose = _first_apart(trial.alike or (), trial.tried, self._settled)
        if pose is None:
            trial.further = self._further(trial) if trial.further is None else trial.further
            pose = _first_apart(trial.further, trial.tried, self._cover)
        if pose is None:
            return None
        trial.tried.append(pose)
        return PoseGuess(GuessReason.RELOCALISATION, pose)

    def _further(self, trial: _Trial) -> Sequence[np.ndarray]:
        """Training views (4, 4): the nearest to the guess first; without one, so that few cover all."""
        poses, tried = self._views.cam_from_object, trial.tried
        order = nearest_first(poses, tried[0], self._cover) if tried else farthest_point_order(poses, self._cover)
        return [poses[i] for i in order]


def _first_apart(poses: Iterable[np.ndarray], tried: Sequence[np.ndarray], apart: Limit) -> np.ndarray | None:
    """The first pose that lies apart from those tried."""
    return next((pose for pose in poses if not any(apart.holds(pose, other) for other in tried)), None)
