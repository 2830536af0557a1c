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
from stages.tracking.scoring import score

_TRUTHS_KEPT = 256


class EachFramePolicy:
    """Frames with guesses of their own, by frame_id; each pass begins where the pass before ended."""

    def __init__(self, config: TrackingConfig, scale: float, guesses: Mapping[int, np.ndarray]) -> None:
        self._config = config
        self._scale = scale
        self._guesses = guesses
        self._settled = Limit(config.settled_deg, config.settled * scale)

    def on_truth(self, frame_id: int, cam_from_object: np.ndarray | None) -> None:
        """The guesses are given; the truth is not asked for."""

    def first_guess(self, frame: FrameInfo) -> PoseGuess | None:
        """PRIOR, or None for a frame without a guess."""
        guess = self._guesses.get(frame.frame_id)
        return None if guess is None else PoseGuess(GuessReason.PRIOR, guess)

    def next_guess(self, attempt: Attempt, result: PoseResult) -> PoseGuess | None:
        """NEXT_PASS until the pose settles or the passes are used up; None after a failure."""
        pose = result.cam_from_object if result.ok else None
        if pose is None or attempt.passes >= self._config.passes:
            return None
        settled = self._settled.holds(attempt.guess.cam_from_object, pose)
        return None if settled else PoseGuess(GuessReason.NEXT_PASS, pose)

    def conclude(self, attempt: Attempt, result: PoseResult) -> Belief:
        """The newest pose that a pass has found; LIMITED where it scores too little to be used in tracking."""
        found = result if result.ok else attempt.earlier
        if found is None:
            return Belief(TrackingState.LOST, 0.0)
        quality = score(found, self._config.score, self._scale)
        usable = quality >= self._config.score.usable
        state = TrackingState.TRACKING if usable else TrackingState.LIMITED
        return Belief(state, quality, found.cam_from_object, found.covariance)

    def missed(self, frame: FrameInfo) -> Belief:
        """Nothing is known of a frame that did not come back."""
        return Belief(TrackingState.LOST, 0.0)


@dataclass(frozen=True)
class Disturbance:
    """How far a guess is from the truth: angle (least, most) in degrees, largest shift in object units."""

    angle_deg: tuple[float, float] = (10.0, 40.0)
    max_translation: float = 0.2


class PerturbedTruthPolicy(EachFramePolicy):
    """Guesses that are the frame's true pose, disturbed as in the paper's section V-B.

    A frame's disturbance depends on the seed and its frame_id alone. A frame has no guess until its truth is known.
    """

    def __init__(self, config: TrackingConfig, scale: float, disturbance: Disturbance) -> None:
        self._known: OrderedDict[int, np.ndarray] = OrderedDict()
        super().__init__(config, scale, self._known)
        self._disturbance = disturbance

    def on_truth(self, frame_id: int, cam_from_object: np.ndarray | None) -> None:
        """Make the frame's guess from its true pose; an object out of view has none."""
        if cam_from_object is None:
            return
        rng = np.random.default_rng([self._config.seed, frame_id])
        disturbance = self._disturbance
        self._known[frame_id] = perturb(cam_from_object, rng, disturbance.angle_deg, disturbance.max_translation)
        if len(self._known) > _TRUTHS_KEPT:
            self._known.popitem(last=False)
