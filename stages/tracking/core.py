"""Tracking: lets frames in at one door, gives each its guesses, and reports what is believed after each.

A pure state machine: every call says what time it is and returns what is to be sent. At all times
received = admitted + dropped + waiting, and admitted = finished + lost + in flight.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fieldpose.bus.messages import Reason, TrackingState
from fieldpose.errors import RefusedError
from fieldpose.stages.geometry.arrays import Transform
from fieldpose.stages.tracking.certainty import with_camera
from fieldpose.stages.tracking.config import DEADLINE_FACTOR, TrackingConfig
from fieldpose.stages.tracking.motion import NS_PER_MS
from fieldpose.stages.tracking.policy import (
    Alike,
    Attempt,
    Belief,
    CarriesOn,
    FrameInfo,
    Look,
    Policy,
    PoseGuess,
    PoseResult,
    Step,
)

_LATENCY_SMOOTHING = 0.2


@dataclass(frozen=True)
class Counts:
    """Frames since the start; `late` counts results that came after they had been given up."""

    received: int = 0
    admitted: int = 0
    finished: int = 0
    lost: int = 0
    dropped_at_the_door: int = 0
    waiting: int = 0
    in_flight: int = 0
    late: int = 0


@dataclass(frozen=True)
class GuessOrder:
    """Render this pose for this frame and pass."""

    frame: FrameInfo
    pass_index: int
    guess: PoseGuess


@dataclass(frozen=True)
class StateReport:
    """A frame has left: finished, lost on its way, or without a guess; what is believed now.

    level: how much less than it might following has done.
    """

    frame: FrameInfo
    pass_index: int
    belief: Belief
    counts: Counts
    level: int = 0


@dataclass(frozen=True)
class LookOrder:
    """Say which training views look like this frame."""

    frame: FrameInfo
    pass_index: int


Output = GuessOrder | LookOrder | StateReport


class Tracker:
    """The door, the frames in flight and their deadlines; a Policy makes the guesses."""

    def __init__(self, config: TrackingConfig, policy: Policy) -> None:
        self._config = config
        self._policy = policy
        self._waiting: tuple[FrameInfo, int] | None = None
        self._in_flight: dict[int, Attempt] = {}
        self._latency_ms: float | None = None
        self._received = self._admitted = self._finished = self._lost = self._dropped = self._late = 0

    @property
    def counts(self) -> Counts:
        return Counts(
            received=self._received,
            admitted=self._admitted,
            finished=self._finished,
            lost=self._lost,
            dropped_at_the_door=self._dropped,
            waiting=int(self._waiting is not None),
            in_flight=len(self._in_flight),
            late=self._late,
        )

    @property
    def deadline_ms(self) -> float:
        """How long a pass may take before its frame is given up."""
        if self._latency_ms is None:
            return self._config.max_deadline_ms
        usual = self._latency_ms * DEADLINE_FACTOR
        return min(max(usual, self._config.min_deadline_ms), self._config.max_deadline_ms)

    def on_frame(self, frame: FrameInfo, now_ns: int, missed: int = 0) -> list[Output]:
        """Take a frame to the door; it replaces one that waits there. `missed`: frames that never came this far."""
        self._received += 1 + missed
        self._dropped += missed + int(self._waiting is not None)
        self._waiting = (frame, now_ns)
        return self._admit(now_ns)

    def on_prior(self, frame_id: int, cam_from_object: np.ndarray, now_ns: int) -> list[Output]:
        """Take in a guess of a frame's pose from outside; it may come before the frame or after."""
        self._policy.on_prior(frame_id, cam_from_object)
        return self._admit(now_ns)

    def on_alike(self, frame_id: int, alike: Alike, now_ns: int) -> list[Output]:
        """Take in the answer to a Look; one that nobody waits for any more is late and changes nothing."""
        attempt = self._in_flight.get(frame_id)
        if attempt is None or not attempt.looking:
            self._late += 1
            return []
        guess = self._policy.after_look(attempt, alike)
        if guess is not None:
            return [self._take_step(attempt, guess, now_ns)]
        nothing = PoseResult(frame_id, max(attempt.pass_index, 0), reason=alike.reason or Reason.NOTHING_ALIKE)
        return self._finish(attempt, nothing, now_ns)

    def on_result(self, result: PoseResult, now_ns: int) -> list[Output]:
        """Take in a result; one that is not of a frame's present pass is late and changes nothing."""
        attempt = self._in_flight.get(result.frame_id)
        if attempt is None or attempt.looking or attempt.pass_index != result.pass_index:
            self._late += 1
            return []
        self._note_latency(now_ns - attempt.sent_ns)
        step = self._policy.next_step(attempt, result)
        if step is not None:
            return [self._take_step(attempt, step, now_ns)]
        return self._finish(attempt, result, now_ns)

    @property
    def begins_at(self) -> Transform | None:
        """Where tracking begins when nothing is known of the camera; None where it tries views, or by frame."""
        return self._policy.begins_at if isinstance(self._policy, CarriesOn) else None

    @property
    def solves_per_s(self) -> float | None:
        """Each frame that is admitted is solved."""
        return None

    def solve_at_least(self, per_second: float) -> None:
        """Raises RefusedError: each frame that is admitted is solved."""
        raise RefusedError("frames are not followed here, so that each is solved; there is no rate to be set")

    @property
    def keyframes(self) -> int | None:
        """No view outlasts its frame."""
        return None

    def take_keyframe(self) -> None:
        """Raises RefusedError: there is nothing that views are kept for."""
        raise RefusedError("frames are not followed here, so that no view is kept; there is no keyframe to take")

    def restart(self, start: Transform | None, now_ns: int) -> list[Output]:
        """Forget what is believed and all frames that have not left; the next begins at `start`, or as the first did.

        What comes for these frames later is late. Raises RefusedError where no frame tells anything of another.
        """
        if not isinstance(self._policy, CarriesOn):
            raise RefusedError("each frame stands by itself here, so that there is nothing to forget or to begin from")
        self._policy.restart(start)
        left, self._in_flight = self._in_flight, {}
        self._lost += len(left)
        waited, self._waiting = self._waiting, None
        self._dropped += int(waited is not None)
        nothing = Belief(TrackingState.INITIALIZING, 0.0, reason=Reason.RESET)
        reports: list[Output] = [self._report(a.frame, max(a.pass_index, 0), nothing) for a in left.values()]
        return reports if waited is None else [*reports, self._report(waited[0], 0, nothing)]

    def on_tick(self, now_ns: int) -> list[Output]:
        """Give up what is past its deadline, and go on without an answer to a Look that is; call it often."""
        late = [a for a in self._in_flight.values() if now_ns - a.sent_ns > self.deadline_ms * NS_PER_MS]
        outputs: list[Output] = []
        for attempt in late:
            if attempt.looking:
                outputs += self.on_alike(attempt.frame.frame_id, Alike(reason=Reason.NO_ANSWER), now_ns)
            else:
                outputs.append(self._give_up(attempt, now_ns))
        return [*self._admit(now_ns), *outputs, *self._turn_away(now_ns)]

    def _admit(self, now_ns: int) -> list[Output]:
        if self._waiting is None or self._full():
            return []
        frame, _ = self._waiting
        step = self._policy.first_step(frame)
        if step is None:
            return []
        self._waiting = None
        self._admitted += 1
        return [self._take_step(Attempt(frame, now_ns), step, now_ns)]

    def _take_step(self, attempt: Attempt, step: Step, now_ns: int) -> GuessOrder | LookOrder:
        frame_id = attempt.frame.frame_id
        if isinstance(step, Look):
            self._in_flight[frame_id] = replace(attempt, looking=True, sent_ns=now_ns)
            return LookOrder(attempt.frame, max(attempt.pass_index, 0))
        attempt = self._in_flight[frame_id] = attempt.again(step, now_ns)
        return GuessOrder(attempt.frame, attempt.pass_index, step)

    def _finish(self, attempt: Attempt, result: PoseResult, now_ns: int) -> list[Output]:
        del self._in_flight[attempt.frame.frame_id]
        self._finished += 1
        belief = self._policy.conclude(attempt, result)
        return [*self._admit(now_ns), self._report(attempt.frame, result.pass_index, belief)]

    def _full(self) -> bool:
        """No place is free, or the waiting frame's number is still in flight (a camera that began again)."""
        again = self._waiting is not None and self._waiting[0].frame_id in self._in_flight
        return again or len(self._in_flight) >= self._config.depth

    def _turn_away(self, now_ns: int) -> list[Output]:
        """Drop the waiting frame if it is only its guess that has been missing for too long."""
        if self._waiting is None or self._full():
            return []
        frame, since_ns = self._waiting
        if now_ns - since_ns <= self._config.guess_wait_ms * NS_PER_MS:
            return []
        self._waiting = None
        self._dropped += 1
        return [self._report(frame, 0, self._policy.missed(frame, Reason.NO_GUESS))]

    def _give_up(self, attempt: Attempt, now_ns: int) -> StateReport:
        del self._in_flight[attempt.frame.frame_id]
        self._lost += 1
        self._note_latency(now_ns - attempt.sent_ns)  # or a pipeline that became slow would stay late for ever
        belief = self._policy.missed(attempt.frame, Reason.NO_ANSWER)
        return self._report(attempt.frame, max(attempt.pass_index, 0), belief)

    def _note_latency(self, latency_ns: int) -> None:
        latency_ms = latency_ns / NS_PER_MS
        usual = latency_ms if self._latency_ms is None else self._latency_ms
        self._latency_ms = usual + _LATENCY_SMOOTHING * (latency_ms - usual)

    def _report(self, frame: FrameInfo, pass_index: int, belief: Belief) -> StateReport:
        return StateReport(frame, pass_index, with_camera(belief, frame), self.counts)
