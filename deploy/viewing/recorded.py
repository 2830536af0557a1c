"""The frames of a recording, each read when it is asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fieldpose.bus.messages import CameraInfo, Correspondences, Frame, Message, State, TrackingState
from fieldpose.bus.reading import read_recording, recorded_at
from fieldpose.bus.topics import CORRESPONDENCES, FOLLOWED, FRAME, STATE, Topic
from fieldpose.deploy.reporting.gathering import recorded_pipeline
from fieldpose.deploy.viewing.history import BY_HEADER, IN_FULL, History
from fieldpose.deploy.viewing.moments import WATCHED, Moment, Moments
from fieldpose.errors import RecordingError
from fieldpose.stages.geometry import Camera

_LONGEST_S = 24 * 3600
_READ_AGAIN = (FRAME, STATE, FOLLOWED)
_TOPICS: set[Topic[Any]] = {*WATCHED, *BY_HEADER, *IN_FULL}


@dataclass
class _Known:
    """What is kept of a frame: when its messages were received, by topic, and little else."""

    camera: Camera | None = None
    sent_ns: int | None = None
    when: dict[Topic[Any], int] = field(default_factory=dict)
    place: tuple[np.ndarray, TrackingState] | None = None


class RecordedMoments:
    """The answered frames of a pipeline of a recording, in the order that they were taken.

    Raises RecordingError where it holds none, and UsageError where `pipeline` (OBJECT/CAMERA) is not one of several.
    """

    def __init__(self, path: Path, pipeline: str | None = None) -> None:
        self._path, self._address = path, recorded_pipeline(path, pipeline)
        self.history = History(_LONGEST_S)
        known: dict[tuple[int, int], _Known] = {}
        lifted: list[int] = []
        for recorded in read_recording(path, _TOPICS):
            if not self._address.covers(recorded.key):
                continue
            if recorded.topic in BY_HEADER:
                self.history.note_header(recorded.topic, recorded.message.header, recorded.log_time_ns)
            if recorded.topic in IN_FULL:
                self.history.note(recorded.message, recorded.log_time_ns)
            if recorded.topic is CORRESPONDENCES:
                lifted.append(recorded.log_time_ns)
            if recorded.topic in WATCHED:
                _note(known, recorded.topic, recorded.message, recorded.log_time_ns)
        self._frames = sorted(
            ((capture_ns, frame_id, each) for (frame_id, capture_ns), each in known.items() if STATE in each.when),
            key=lambda item: item[:2],
        )
        if not self._frames:
            raise RecordingError(f"{path}: holds no states of tracking, so nothing to look at")
        self._lifted = np.array(lifted, np.int64)
        self.seconds: np.ndarray = (np.array([at for at, _, _ in self._frames]) - self._frames[0][0]) / 1e9
        """(n,) when each frame was taken, from the first."""
        placed = [(index, each.place) for index, (_, _, each) in enumerate(self._frames) if each.place is not None]
        self._placed = np.array([index for index, _ in placed], int)
        self._way = [place for _, place in placed]

    def __len__(self) -> int:
        return len(self._frames)

    def at(self, index: int) -> Moment:
        """A frame with its image, and the points of its own solve, or of the newest by then."""
        capture_ns, frame_id, known = self._frames[index]
        moments = Moments(kept=None)
        for topic in _READ_AGAIN:
            if topic in known.when:
                for message in self._read(topic, known.when[topic]):
                    if message.header.frame_key == (frame_id, capture_ns):
                        moments.note(message)
        moment = moments.newest(with_image=False) or Moment(frame_id, capture_ns)
        return Moment(
            frame_id, capture_ns, moment.frame, known.camera, known.sent_ns, moment.state, moment.followed,
            self._lifted_by(known.when.get(CORRESPONDENCES, known.when[STATE])),
        )  # fmt: skip

    def way(self, index: int) -> Sequence[tuple[np.ndarray, TrackingState]]:
        """Where the camera was measured to be up to a frame, and how sure tracking was."""
        return self._way[: int(np.searchsorted(self._placed, index, side="right"))]

    def after(self, index: int, seconds: float) -> int:
        """The frame that was taken so long after another; the first again after the last, at least the next one."""
        if index >= len(self) - 1:
            return 0
        there = int(np.searchsorted(self.seconds, self.seconds[index] + seconds, side="right")) - 1
        return max(index + 1, there)

    def _lifted_by(self, log_time_ns: int) -> Correspondences | None:
        count = int(np.searchsorted(self._lifted, log_time_ns, side="right"))
        if not count:
            return None
        messages = self._read(CORRESPONDENCES, int(self._lifted[count - 1]))
        return next((message for message in messages if isinstance(message, Correspondences)), None)

    def _read(self, topic: Topic[Any], log_time_ns: int) -> list[Message]:
        return [each.message for each in recorded_at(self._path, topic, self._address.key(topic), log_time_ns)]


def _note(known: dict[tuple[int, int], _Known], topic: Topic[Any], message: Message, log_time_ns: int) -> None:
    """Take in when a message was received, and what of it is needed of all frames at once."""
    each = known.setdefault(message.header.frame_key, _Known())
    match message:
        case Frame() | CameraInfo():
            each.camera = message.camera
            each.sent_ns = each.sent_ns or message.header.sent_ns
        case State():
            each.place = Moment(message.header.frame_id, message.header.capture_ns, state=message).place
    if topic in (*_READ_AGAIN, CORRESPONDENCES):
        each.when[topic] = log_time_ns
