"""Frames in a recording, as if a camera had sent them."""

from __future__ import annotations

from collections import Counter

import msgspec

from fieldpose.bus.messages import Header
from fieldpose.bus.recording import RecordingWriter
from fieldpose.bus.topics import Address
from fieldpose.stages.camera.core import CapturedFrame
from fieldpose.stages.camera.wire import messages_of

_SOURCE = "camera"
_LEAST_NS = 1000
"""Between two frames: readers go by the time at which a frame was sent."""


class FrameLog:
    """Writes frames with all that a camera sends of them, each when it is due and after the one before."""

    def __init__(self, writer: RecordingWriter) -> None:
        self._writer, self._address = writer, Address()
        self._sequence = Counter[str]()
        self._sent_ns = 0

    def write(self, frame: CapturedFrame) -> None:
        """Take in a frame; its time is `at_ns`."""
        capture_ns = frame.at_ns or 0
        self._sent_ns = max(self._sent_ns + _LEAST_NS, capture_ns)
        for topic, message in messages_of(frame, capture_ns):
            number = self._sequence[topic.name]
            header = Header(_SOURCE, number, frame.frame_id, 0, capture_ns, self._sent_ns)
            sent = msgspec.structs.replace(message, header=header)
            self._writer.write(self._address.key(topic), topic, sent, self._sent_ns)
            self._sequence[topic.name] += 1
