"""Tracking as a process: frames, truths and poses in, guesses and states out."""

from __future__ import annotations

import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from fieldpose.bus.messages import Frame, Message, Pose, Retrieved, Truth
from fieldpose.bus.node import Output
from fieldpose.bus.ports import Sequences
from fieldpose.bus.topics import FRAME, GUESS, POSE, RETRIEVED, STATE, TRUTH, Topic
from fieldpose.stages.nerf.field import load_field
from fieldpose.stages.tracking import core
from fieldpose.stages.tracking.config import TrackingConfig
from fieldpose.stages.tracking.guesses import make_policy, needs_truth
from fieldpose.stages.tracking.retrieved import RetrievedPoses
from fieldpose.stages.tracking.views import training_views
from fieldpose.stages.tracking.wire import copied, frame_info, outputs_of, pose_result


class TrackingNode:
    """A Handler around the Tracker. Raises FieldFileError and ConfigError at start."""

    name = "tracking"
    outputs: tuple[Topic, ...] = (GUESS, STATE)

    def __init__(self, field: Path, config: TrackingConfig) -> None:
        truth = (TRUTH,) if needs_truth(config.guess) else ()
        self.inputs: tuple[Topic, ...] = (FRAME, POSE, RETRIEVED, *truth)
        self._field = field
        self._config = config
        self._sequences = Sequences()

    def start(self) -> None:
        views = training_views(load_field(self._field))
        self._retrieved = RetrievedPoses()
        self._tracker = core.Tracker(self._config, make_policy(self._config, views, self._retrieved))

    def handle(self, topic: Topic, message: Message) -> Iterable[Output]:
        return outputs_of(self._take_in(message, time.time_ns()))

    def tick(self, now_ns: int) -> Iterable[Output]:
        return outputs_of(self._tracker.on_tick(now_ns))

    def stop(self) -> None:
        """Nothing is held."""

    def _take_in(self, message: Message, now_ns: int) -> list[core.Output]:
        match message:
            case Frame():
                missed = self._sequences.seen(FRAME.name, message.header)
                return self._tracker.on_frame(frame_info(message), now_ns, missed)
            case Truth():
                truth = copied(message.cam_from_object)
                return self._tracker.on_truth(message.header.frame_id, truth, now_ns)
            case Retrieved():
                poses = np.array(message.cam_from_object)
                self._retrieved.add(message.header.frame_id, message.header.capture_ns, list(poses))
                return []
            case Pose():
                return self._tracker.on_pose(pose_result(message), now_ns)
            case _:
                raise TypeError(f"tracking takes no {type(message).__name__}")
