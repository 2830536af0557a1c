"""Tracking as a process: what cameras and stages say in, searches, guesses and states out."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import Any

from fieldpose.bus.logs import Throttle, stage_logger
from fieldpose.bus.messages import CameraInfo, Failure, Message, Pose, Prior, Retrieved
from fieldpose.bus.node import Output
from fieldpose.bus.ports import Sequences
from fieldpose.bus.topics import CAMERA_INFO, FAILURE, GUESS, POSE, PRIOR, RETRIEVED, SEARCH, STATE, Topic
from fieldpose.stages.geometry import is_rigid
from fieldpose.stages.tracking import core
from fieldpose.stages.tracking.wire import RIGID_TOLERANCE, alike, copied, failed, frame_info, outputs_of, pose_result


class TrackingNode:
    """A Handler around the Tracker that `make_tracker` gives at start."""

    name = "tracking"
    inputs: tuple[Topic[Any], ...] = (CAMERA_INFO, PRIOR, RETRIEVED, POSE, FAILURE)
    outputs: tuple[Topic[Any], ...] = (SEARCH, GUESS, STATE)

    def __init__(self, make_tracker: Callable[[], core.Tracker]) -> None:
        self._make_tracker = make_tracker
        self._sequences = Sequences()
        self._throttle = Throttle(stage_logger(self.name))

    def start(self) -> None:
        self._tracker = self._make_tracker()

    def handle(self, topic: Topic[Any], message: Message) -> Iterable[Output]:
        return outputs_of(self._take_in(message, time.time_ns()))

    def tick(self, now_ns: int) -> Iterable[Output]:
        return outputs_of(self._tracker.on_tick(now_ns))

    def stop(self) -> None:
        """Nothing is held."""

    def _take_in(self, message: Message, now_ns: int) -> list[core.Output]:
        tracker, header = self._tracker, message.header
        match message:
            case CameraInfo():
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
