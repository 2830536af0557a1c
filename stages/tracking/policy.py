"""What the Tracker and its policies say to each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

from fieldpose.bus.messages import CameraOrigin, GuessReason, Reason, TrackingState
from fieldpose.stages.geometry import Camera
from fieldpose.stages.geometry.arrays import Covariance, Transform


@dataclass(frozen=True)
class FrameInfo:
    """A camera frame without its pixels."""

    frame_id: int
    capture_ns: int
    camera: Camera
    camera_origin: CameraOrigin = CameraOrigin.CALIBRATED


@dataclass(frozen=True)
class PoseGuess:
    """A pose to render; `epoch` tells guesses made before a loss or a recovery from those made after."""

    reason: GuessReason
    cam_from_object: Transform
    epoch: int = 0


@dataclass(frozen=True)
class Look:
    """Ask which training views look like the frame, before anything is rendered."""


@dataclass(frozen=True)
class Alike:
    """cam_from_object of training views that look like a frame, the most alike first, or why there are none."""

    poses: Sequence[Transform] = ()
    reason: Reason | None = None


@dataclass(frozen=True)
class PoseResult:
    """What came back for a pass over a frame: a pose, or the reason why there is none."""

    frame_id: int
    pass_index: int
    cam_from_object: Transform | None = None
    covariance: Covariance | None = None
    inliers: int = 0
    correspondences: int = 0
    residual_px: float | None = None
    reason: Reason | None = None


@dataclass(frozen=True)
class Attempt:
    """A frame in flight, with the guess of its present pass; None before the first.

    pass_index counts all its passes, `passes` those since a fresh guess. looking: an answer to a Look is awaited.
    """

    frame: FrameInfo
    sent_ns: int
    guess: PoseGuess | None = None
    looking: bool = False
    pass_index: int = -1
    passes: int = 0
    retries: int = -1

    @property
    def epoch(self) -> int:
        """That of its guess; of none, -1."""
        return -1 if self.guess is None else self.guess.epoch

    def again(self, guess: PoseGuess, now_ns: int) -> Attempt:
        """The next pass over this frame."""
        carried_on = guess.reason is GuessReason.NEXT_PASS
        return replace(
            self,
            guess=guess,
            sent_ns=now_ns,
            looking=False,
            pass_index=self.pass_index + 1,
            passes=self.passes + 1 if carried_on else 1,
            retries=self.retries if carried_on else self.retries + 1,
        )


@dataclass(frozen=True)
class Belief:
    """Where the camera is believed to be at a frame's capture time, or why nothing is believed of it."""

    state: TrackingState
    score: float
    cam_from_object: Transform | None = None
    covariance: Covariance | None = None
    reason: Reason | None = None


Step = PoseGuess | Look
"""What is to be done next for a frame."""


class Policy(Protocol):
    """Makes the guesses and judges the results; the Tracker keeps the door and the clock."""

    def on_prior(self, frame_id: int, cam_from_object: Transform) -> None:
        """A guess of a frame's pose has come from outside, before the frame or after."""
        ...

    def first_step(self, frame: FrameInfo) -> Step | None:
        """What to do for a new frame; None while it waits for its prior."""
        ...

    def after_look(self, attempt: Attempt, alike: Alike) -> PoseGuess | None:
        """The guess once it is known which training views look like the frame; None where there is none to try."""
        ...

    def next_step(self, attempt: Attempt, result: PoseResult) -> Step | None:
        """What to do for another pass over the same frame; None when its result is final."""
        ...

    def conclude(self, attempt: Attempt, result: PoseResult) -> Belief:
        """What is believed after a frame's last pass."""
        ...

    def missed(self, frame: FrameInfo, reason: Reason) -> Belief:
        """What is believed about a frame that has no result: lost on its way, or without a guess."""
        ...


@runtime_checkable
class CarriesOn(Protocol):
    """A Policy to which the frames before tell something, so that it can forget that and begin again."""

    @property
    def begins_at(self) -> Transform | None:
        """Where it begins when nothing is known of the camera; None where training views are tried."""

    def restart(self, start: Transform | None = None) -> None:
        """Forget all that frames have told, and begin at `start`, or without one as it first did."""
