"""Tracking as a process: what cameras and stages say in, searches, guesses and states out; and requests."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import cv2
import numpy as np

from fieldpose.bus.logs import Throttle, stage_logger
from fieldpose.bus.messages import CameraInfo, Failure, Frame, Message, Pose, Prior, Retrieved, View
from fieldpose.bus.node import Output
from fieldpose.bus.ports import Sequences
from fieldpose.bus.requests import ControlValues, Request
from fieldpose.bus.topics import (
    CAMERA_INFO,
    CONTROL,
    FAILURE,
    FOLLOWED,
    FRAME,
    GUESS,
    POSE,
    PRIOR,
    RETRIEVED,
    SEARCH,
    STATE,
    VIEW,
    Topic,
)  # fmt: skip
from fieldpose.stages.following.core import warm_up
from fieldpose.stages.following.wire import See
from fieldpose.stages.geometry import RIGID_TOLERANCE, is_rigid
from fieldpose.stages.tracking import core
from fieldpose.stages.tracking.control import Controls
from fieldpose.stages.tracking.following import FollowingTracker
from fieldpose.stages.tracking.wire import Said, alike, copied, failed, frame_info, outputs_of, pose_result


class TrackingNode:
    """A Handler, and Controlled, around the tracker that `make_tracker` gives at start.

    see: makes a frame ready to be followed; with it, frames and views are read with their pixels. clock: the time in
    nanoseconds since the epoch.
    """

    name = "tracking"
    outputs: tuple[Topic[Any], ...] = (SEARCH, GUESS, FOLLOWED, STATE, CONTROL)

    def __init__(
        self, make_tracker: Callable[[], core.Tracker | FollowingTracker], see: See | None = None
    ) -> None:  # fmt: skip
        seen = (CAMERA_INFO,) if see is None else (FRAME, VIEW)
        self.inputs: tuple[Topic[Any], ...] = (*seen, PRIOR, RETRIEVED, POSE, FAILURE)
        self._make_tracker, self._see = make_tracker, see
        self.clock = time.time_ns
        self._sequences = Sequences()
        self._throttle = Throttle(stage_logger(self.name))

    def start(self) -> None:
        self._tracker = self._make_tracker()
        self._controls = Controls(self._tracker)
        if self._see is not None:
            warm_up()

    def handle(self, topic: Topic[Any], message: Message) -> Iterable[Output]:
        if topic in (FRAME, CAMERA_INFO):
            self._controls.came(message.header.frame_id)
        return outputs_of(self._controls.note(self._take_in(message, self.clock())))

    def tick(self, now_ns: int) -> Iterable[Output]:
        return outputs_of(self._controls.note(self._tracker.on_tick(now_ns)))

    def control(self, request: Request[Any], now_ns: int) -> tuple[ControlValues, Iterable[Output]]:
        """Carry out a request. Raises RefusedError."""
        return self._controls.carry_out(request, now_ns)

    def stop(self) -> None:
        """Nothing is held."""

    def _take_in(self, message: Message, now_ns: int) -> Sequence[Said]:
        tracker, header = self._tracker, message.header
        match message:
            case Frame() if isinstance(tracker, FollowingTracker) and self._see is not None:
                return self._follow(tracker, message, self._see, now_ns)
            case View() if isinstance(tracker, FollowingTracker):
                grey, pose = cv2.cvtColor(np.array(message.rgb), cv2.COLOR_RGB2GRAY), copied(message.cam_from_object)
                depth = np.array(message.depth)
                tracker.on_view(header.frame_id, message.view_id, grey, depth, message.camera, pose, now_ns)
                return []
            case CameraInfo() if isinstance(tracker, core.Tracker):
                return tracker.on_frame(frame_info(message), now_ns, self._sequences.seen(CAMERA_INFO.name, header))
            case Prior():
                pose = copied(message.cam_from_object)
                if not is_rigid(pose, RIGID_TOLERANCE):
                    self._throttle.warning("a prior that is no rigid transform", frame=header.frame_id)
                    return []
                return tracker.on_prior(header.frame_id, pose, now_ns)
            case Retrieved() | Failure(stage="retrieval"):
                return tracker.on_alike(header.frame_id, alike(message), now_ns)
            case Pose():
                return tracker.on_result(pose_result(message), now_ns)
            case Failure():
                return tracker.on_result(failed(message), now_ns)
            case _:
                raise TypeError(f"tracking takes no {type(message).__name__}")

    def _follow(self, tracker: FollowingTracker, frame: Frame, see: See, now_ns: int) -> Sequence[Said]:
        began_ns = self.clock()
        missed = self._sequences.seen(FRAME.name, frame.header)
        outputs = tracker.on_frame(frame_info(frame), see(frame), now_ns, missed)
        tracker.took((self.clock() - began_ns) * 1e-6)
        return outputs
