"""Guesses given for each frame by itself, as an evaluation needs them: no frame learns from another."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from cachetools import FIFOCache

from fieldpose.bus.messages import GuessReason, TrackingState
from fieldpose.stages.geometry import Limit, perturb
from fieldpose.stages.tracking.certainty import Certainty
from fieldpose.stages.tracking.config import TrackingConfig
from fieldpose.stages.tracking.policy import Attempt, Belief, FrameInfo, PoseGuess, PoseResult
from fieldpose.stages.tracking.retrieved import Poses
from fieldpose.stages.tracking.scoring import believed, score
from fieldpose.stages.tracking.views import TrainingViews, nearest_first

_TRUTHS_KEPT = 256


@dataclass
class _Trial:
    """A frame in flight: the poses that have been tried, its guess first, and what is believed so far.

    near: training views, those nearest to the guess first; None until they are asked for.
    """

    tried: list[np.ndarray]
    found: Belief | None = None
    near: np.ndarray | None = None


class EachFramePolicy:
    """Frames with guesses of their own, by frame_id; each pass begins where the pass before ended.

    Where the guess leads to no pose that is believed, training views are tried in its place: those that look like
    the frame, as `retrieved` says, then those nearest to the guess. A pose that is not believed is none; with a
    single pass there is nothing to confirm it by, and every usable one counts.
    """

    def __init__(
        self,
        config: TrackingConfig,
        views: TrainingViews,
        guesses: Mapping[int, np.ndarray],
        retrieved: Callable[[FrameInfo], Poses] = lambda frame: (),
    ) -> None:
        self._retrieved = retrieved
        self._config = config
        self._views = views
        self._scale = views.scale
        self._certainty = Certainty(views.error_scale, self._scale)
        self._guesses = guesses
        self._settled = Limit(config.settled_deg, config.settled * self._scale)
        self._trials: dict[int, _Trial] = {}

    def on_truth(self, frame_id: int, cam_from_object: np.ndarray | None) -> None:
        """The guesses are given; the truth is not asked for."""

    def first_guess(self, frame: FrameInfo) -> PoseGuess | None:
        """PRIOR, or None for a frame without a guess."""
        guess = self._guesses.get(frame.frame_id)
        if guess is None:
            return None
        self._trials[frame.frame_id] = _Trial([guess])
        return PoseGuess(GuessReason.PRIOR, guess)

    def next_guess(self, attempt: Attempt, result: PoseResult) -> PoseGuess | None:
        """NEXT_PASS until the pose settles or the passes are used up; then RELOCALISATION unless one is believed."""
        trial, guess = self._trials[attempt.frame.frame_id], attempt.guess.cam_from_object
        quality, pose = self._quality(result), result.cam_from_object
        if pose is not None and quality >= self._config.score.usable:
            trial.found = self._belief(attempt, result) or trial.found
            if attempt.passes < self._config.passes and not self._settled.holds(guess, pose):
                return PoseGuess(GuessReason.NEXT_PASS, pose)
        if self._config.passes == 1 or trial.found is not None:
            return None
        return self._search(attempt.frame, trial)

    def conclude(self, attempt: Attempt, result: PoseResult) -> Belief:
        """The newest pose that was believed, TRACKING; LOST without one."""
        found = self._trials.pop(attempt.frame.frame_id).found
        return self._belief(attempt, result) or found or Belief(TrackingState.LOST, 0.0)

    def missed(self, frame: FrameInfo) -> Belief:
        """Nothing is known of a frame that did not come back."""
        self._trials.pop(frame.frame_id, None)
        return Belief(TrackingState.LOST, 0.0)

    def _quality(self, result: PoseResult) -> float:
        return score(result, self._config.score, self._scale)

    def _belief(self, attempt: Attempt, result: PoseResult) -> Belief | None:
        """TRACKING at the pose that was found; None if it is not believed."""
        pose, guess = result.cam_from_object, attempt.guess.cam_from_object
        if pose is None or not self._believes(attempt, result):
            return None
        covariance = self._certainty.of(result.covariance, guess, pose)
        return Belief(TrackingState.TRACKING, self._quality(result), pose, covariance)

    def _believes(self, attempt: Attempt, result: PoseResult) -> bool:
        if self._config.passes == 1:
            return self._quality(result) >= self._config.score.usable
        return believed(result, attempt.guess.cam_from_object, self._config, self._scale)

    def _search(self, frame: FrameInfo, trial: _Trial) -> PoseGuess | None:
        """The next training view to try; None when as many have been as may be."""
        if len(trial.tried) > self._config.searches:
            return None
        cover = Limit(self._config.cover_deg, self._config.cover * self._scale)
        pose = _untried(self._retrieved(frame), trial.tried, self._settled)
        if pose is None:
            if trial.near is None:
                poses = self._views.cam_from_object
                trial.near = poses[nearest_first(poses, trial.tried[0], cover)]
            pose = _untried(trial.near, trial.tried, cover)
        if pose is None:
            return None
        trial.tried.append(pose)
        return PoseGuess(GuessReason.RELOCALISATION, pose)


def _untried(poses: Iterable[np.ndarray], tried: Sequence[np.ndarray], apart: Limit) -> np.ndarray | None:
    """The first pose that lies apart from those tried."""
    return next((pose for pose in poses if not any(apart.holds(pose, other) for other in tried)), None)


@dataclass(frozen=True)
class Disturbance:
    """How far a guess is from the truth: angle (least, most) in degrees, largest shift in object units."""

    angle_deg: tuple[float, float] = (10.0, 40.0)
    max_translation: float = 0.2


class PerturbedTruthPolicy(EachFramePolicy):
    """Guesses that are the frame's true pose, disturbed as in the paper's section V-B.

    A frame's disturbance depends on the seed and its frame_id alone. A frame has no guess until its truth is known.
    """

    def __init__(
        self,
        config: TrackingConfig,
        views: TrainingViews,
        disturbance: Disturbance,
        retrieved: Callable[[FrameInfo], Poses] = lambda frame: (),
    ) -> None:
        self._known: FIFOCache[int, np.ndarray] = FIFOCache(_TRUTHS_KEPT)
        super().__init__(config, views, self._known, retrieved)
        self._disturbance = disturbance

    def on_truth(self, frame_id: int, cam_from_object: np.ndarray | None) -> None:
        """Make the frame's guess from its true pose; an object out of view has none."""
        if cam_from_object is None:
            return
        rng = np.random.default_rng([self._config.seed, frame_id])
        disturbance = self._disturbance
        self._known[frame_id] = perturb(cam_from_object, rng, disturbance.angle_deg, disturbance.max_translation)
