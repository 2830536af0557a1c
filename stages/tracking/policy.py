"""What the Tracker and its policies say to each other."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from fieldpose.bus.messages import GuessReason, TrackingState


@dataclass(frozen=True)
class FrameInfo:
    """A camera frame without its pixels; `camera` is only carried along."""

    frame_id: int
    capture_ns: int
    camera: Any = None


@dataclass(frozen=True)
class PoseGuess:
    """A pose to render; `epoch` tells guesses made before a loss or a recovery from those made after."""

    reason: GuessReason
    cam_from_object: np.ndarray
    epoch: int = 0


@dataclass(frozen=True)
class PoseResult:
    """What came back for a pass over a frame."""

    frame_id: int
    pass_index: int
    ok: bool
    cam_from_object: np.ndarray | None = None
    covariance: np.ndarray | None = None
    inliers: int = 0
    correspondences: int = 0
    residual_px: float | None = None


@dataclass(frozen=True)
class Attempt:
    """A frame in flight.

    pass_index counts all its passes, `passes` those since a fresh guess.
    """

    frame: FrameInfo
    guess: PoseGuess
    sent_ns: int
    pass_index: int = 0
    passes: int = 1
    retries: int = 0

    def again(self, guess: PoseGuess, now_ns: int) -> Attempt:
        """The next pass over this frame."""
        carried_on = guess.reason is GuessReason.NEXT_PASS
        return replace(
            self,
            guess=guess,
            sent_ns=now_ns,
            pass_index=self.pass_index + 1,
            passes=self.passes + 1 if carried_on else 1,
            retries=self.retries if carried_on else self.retries + 1,
        )


@dataclass(frozen=True)
class Belief:
    """Where the camera is believed to be at a frame's capture time; no pose where nothing is believed."""

    state: TrackingState
    score: float
    cam_from_object: np.ndarray | None = None
    covariance: np.ndarray | None = None


class Policy(Protocol):
    """Makes the guesses and judges the results; the Tracker keeps the door and the clock."""

    def on_truth(self, frame_id: int, cam_from_object: np.ndarray | None) -> None:
        """A frame's true pose has become known; None where the object is out of view."""
        ...

    def first_guess(self, frame: FrameInfo) -> PoseGuess | None:
        """The guess for a new frame; None while it is not known yet."""
        ...

    def next_guess(self, attempt: Attempt, result: PoseResult) -> PoseGuess | None:
        """The guess for another pass over the same frame; None when its result is final."""
        ...

    def conclude(self, attempt: Attempt, result: PoseResult) -> Belief:
        """What is believed after a frame's last pass."""
        ...

    def missed(self, frame: FrameInfo) -> Belief:
        """What is believed about a frame that has no result: lost on its way, or without a guess."""
        ...
