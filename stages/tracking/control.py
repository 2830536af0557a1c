"""What can be asked of tracking while it runs: to begin again or elsewhere, to solve more often, to keep a view."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from fieldpose.bus.messages import Changes, Control, TrackingState
from fieldpose.bus.node import Output, first_header
from fieldpose.bus.requests import ControlValues, Request, Reset, SetGuess, SetSolving, Show, TakeKeyframe
from fieldpose.bus.topics import CONTROL
from fieldpose.errors import RefusedError
from fieldpose.stages.geometry import nearest_rigid
from fieldpose.stages.tracking.core import StateReport, Tracker
from fieldpose.stages.tracking.following import FollowingTracker
from fieldpose.stages.tracking.wire import Said, copied, outputs_of


class Controls:
    """Carries out requests on a tracker, and knows what can be told of it."""

    def __init__(self, tracker: Tracker | FollowingTracker) -> None:
        self._tracker = tracker
        self._state = TrackingState.INITIALIZING
        self._newest: int | None = None
        self._requests = 0

    def came(self, frame_id: int) -> None:
        """A frame has come."""
        self._newest = frame_id

    def note(self, said: Sequence[Said]) -> Sequence[Said]:
        """Take in what is believed of frames."""
        for each in said:
            if isinstance(each, StateReport):
                self._state = each.belief.state
        return said

    def carry_out(self, request: Request[Any], now_ns: int) -> tuple[ControlValues, list[Output]]:
        """Do what is asked; how things are then, and what is to be sent. Raises RefusedError, and changes nothing."""
        if isinstance(request, Show):
            return self._values(), []
        try:
            done, said = self._done(request, now_ns)
        except RefusedError as error:
            raise RefusedError(f"{request.kind}: {error}") from None
        self._requests += 1
        return self._values(), [(CONTROL, done), *outputs_of(self.note(said))]

    def _done(self, request: Request[Any], now_ns: int) -> tuple[Control, Sequence[Said]]:
        tracker = self._tracker
        match request:
            case Reset():
                said: Sequence[Said] = tracker.restart(None, now_ns)
                self._state = TrackingState.INITIALIZING
                return self._accepted("reset", now_ns), said
            case SetGuess():
                pose = nearest_rigid(copied(request.cam_from_object))
                said = tracker.restart(pose, now_ns)
                self._state = TrackingState.INITIALIZING
                return self._accepted("set_guess", now_ns, pose), said
            case SetSolving():
                tracker.solve_at_least(request.solves_per_s)
                return self._accepted("set_solving", now_ns, solves_per_s=request.solves_per_s), []
            case TakeKeyframe():
                tracker.take_keyframe()
                return self._accepted("take_keyframe", now_ns), []
        raise RefusedError("tracking takes no such request")

    def _accepted(
        self, request: Changes, now_ns: int, pose: np.ndarray | None = None, solves_per_s: float | None = None
    ) -> Control:
        return Control(
            header=first_header(0, now_ns), request=request, after_frame=self._newest, cam_from_object=pose,
            solves_per_s=solves_per_s,
        )  # fmt: skip

    def _values(self) -> ControlValues:
        tracker = self._tracker
        return ControlValues(
            state=self._state, frames=tracker.counts.received, requests=self._requests,
            solves_per_s=tracker.solves_per_s, begins_at=tracker.begins_at, keyframes=tracker.keyframes,
        )  # fmt: skip
