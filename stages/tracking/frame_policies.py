"""Guesses given for each frame by itself, as an evaluation needs them: no frame learns from another."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bus.messages import GuessReason, TrackingState
from stages.geometry import perturb
from stages.tracking.config import TrackingConfig
from stages.tracking.distance import Limit
from stages.tracking.policy import Attempt, Belief, FrameInfo, PoseGuess, PoseResult
from stages.tracking.scoring import believed, score
from stages.tracking.views import TrainingViews, nearest_first

_FRAMES_KEPT = 256


class EachFramePolicy:
    """Frames with guesses of their own, by frame_id; each pass begins where the pass before ended.

    Where the guess leads to no pose that is believed, training views are tried in its place. A pose that is not
    believed is none; with a single pass there is nothing to confirm it by, and every usable one counts.
    """

    def __init__(self, config: TrackingConfig, views: TrainingViews, guesses: Mapping[int, np.ndarray]) -> None:
        self._config = config
        self._views = views
        self._scale = views.scale
        self._guesses = guesses
        self._settled = Limit(config.settled_deg, config.settled * self._scale)
        self._others: OrderedDict[int, list[np.ndarray]] = OrderedDict()

    def on_truth(self, frame_id: int, cam_from_object: np.ndarray | None) -> None:
        """The guesses are given; the truth is not asked for."""

    def first_guess(self, frame: FrameInfo) -> PoseGuess | None:
        """PRIOR, or None for a frame without a guess."""
        guess = self._guesses.get(frame.frame_id)
        return None if guess is None else PoseGuess(GuessReason.PRIOR, guess)

    def next_guess(self, attempt: Attempt, result: PoseResult) -> PoseGuess | None:
        """NEXT_PASS until the pose settles or the passes are used up; then RELOCALISATION unless it is believed."""
        pose = result.cam_from_object if self._quality(result) >= self._config.score.usable else None
        more = attempt.passes < self._config.passes
        if more and pose is not None and not self._settled.holds(attempt.guess.cam_from_object, pose):
            return PoseGuess(GuessReason.NEXT_PASS, pose)
        if self._config.passes == 1 or self._believed(attempt, result) is not None:
            return None
        others = self._other_guesses(attempt.frame.frame_id)
        return PoseGuess(GuessReason.RELOCALISATION, others[attempt.retries]) if attempt.retries < len(others) else None

    def conclude(self, attempt: Attempt, result: PoseResult) -> Belief:
        """The newest pose that is believed, TRACKING; LOST without one."""
        self._others.pop(attempt.frame.frame_id, None)
        found = self._believed(attempt, result)
        if found is None:
            return Belief(TrackingState.LOST, self._quality(result))
        return Belief(TrackingState.TRACKING, self._quality(found), found.cam_from_object, found.covariance)

    def missed(self, frame: FrameInfo) -> Belief:
        """Nothing is known of a frame that did not come back."""
        self._others.pop(frame.frame_id, None)
        return Belief(TrackingState.LOST, 0.0)

    def _quality(self, result: PoseResult) -> float:
        return score(result, self._config.score, self._scale)

    def _believed(self, attempt: Attempt, result: PoseResult) -> PoseResult | None:
        if self._config.passes == 1:
            return result if self._quality(result) >= self._config.score.usable else None
        if believed(result, attempt.guess.cam_from_object, self._config, self._scale):
            return result
        earlier = attempt.earlier
        return earlier if earlier is not None and believed(earlier, None, self._config, self._scale) else None

    def _other_guesses(self, frame_id: int) -> list[np.ndarray]:
        """Training views in the order in which they are tried for a frame."""
        if frame_id not in self._others:
            cover = Limit(self._config.cover_deg, self._config.cover * self._scale)
            order = nearest_first(self._views.cam_from_object, self._guesses[frame_id], cover)
            self._others[frame_id] = [self._views.cam_from_object[i] for i in order[: self._config.searches]]
            if len(self._others) > _FRAMES_KEPT:
                self._others.popitem(last=False)
        return self._others[frame_id]


@dataclass(frozen=True)
class Disturbance:
    """How far a guess is from the truth: angle (least, most) in degrees, largest shift in object units."""

    angle_deg: tuple[float, float] = (10.0, 40.0)
    max_translation: float = 0.2


class PerturbedTruthPolicy(EachFramePolicy):
    """Guesses that are the frame's true pose, disturbed as in the paper's section V-B.

    A frame's disturbance depends on the seed and its frame_id alone. A frame has no guess until its truth is known.
    """

    def __init__(self, config: TrackingConfig, views: TrainingViews, disturbance: Disturbance) -> None:
        self._known: OrderedDict[int, np.ndarray] = OrderedDict()
        super().__init__(config, views, self._known)
        self._disturbance = disturbance

    def on_truth(self, frame_id: int, cam_from_object: np.ndarray | None) -> None:
        """Make the frame's guess from its true pose; an object out of view has none."""
        if cam_from_object is None:
            return
        rng = np.random.default_rng([self._config.seed, frame_id])
        disturbance = self._disturbance
        self._known[frame_id] = perturb(cam_from_object, rng, disturbance.angle_deg, disturbance.max_translation)
        if len(self._known) > _FRAMES_KEPT:
            self._known.popitem(last=False)
