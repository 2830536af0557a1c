"""A recording as a file of Foxglove's schemas."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

from fieldpose.bus.foreign import ForeignWriter
from fieldpose.bus.reading import read_recording
from fieldpose.bus.topics import CAMERA_INFO, FRAME, Address
from fieldpose.deploy.foxglove.channels import ALL
from fieldpose.deploy.foxglove.converter import Converted, Converter, clock_behind_ns
from fieldpose.deploy.reporting.trajectories import in_words
from fieldpose.stages.nerf.metadata import FieldMetadata

RECORD = "fieldpose"
_LATEST_NS = 5_000_000_000
_ROOM = 512 << 20


def export(recording: Path, out: Path, address: Address, field: FieldMetadata | None) -> dict[str, int]:
    """Write one pipeline of a recording; returns topic -> number of messages, of all topics.

    Messages have their frame's capture time as log time, and the time of their being sent as publish time; what is of
    no frame has its own time, by the frames' clock. True poses are written where the field is known. Raises
    RecordingError and OutputError.
    """
    moved = None if field is None else field.frame.object_from_dataset
    converter = Converter(object_from_dataset=moved, behind_ns=_behind_ns(recording, address))
    counts: Counter[str] = Counter({channel.topic: 0 for channel in ALL})
    with ForeignWriter(out) as writer:
        for channel in ALL:
            writer.channel(channel.topic, channel.encoding, channel.schema)
        found = (one for one in read_recording(recording) if address.covers(one.key))
        for message in in_order(each for one in found for each in converter.convert(one.topic, one.message)):
            topic = message.channel.topic
            writer.write(topic, message.payload, message.log_ns, message.publish_ns, message.sequence)
            counts[topic] += 1
        writer.add(RECORD, about(recording.name, address, field))
    return dict(counts)


def about(recording: str, address: Address, field: FieldMetadata | None) -> dict[str, str]:
    """What the file says of itself."""
    return {
        "recording": recording, "object": address.object, "camera": address.camera, "lengths": in_words(field),
    }  # fmt: skip


def _behind_ns(recording: Path, address: Address) -> int:
    told = (one for one in read_recording(recording, (CAMERA_INFO, FRAME)) if address.covers(one.key))
    first = next(told, None)
    return 0 if first is None else clock_behind_ns(first.message.header)


def in_order(messages: Iterable[Converted], room: int = _ROOM) -> Iterator[Converted]:
    """Messages by their log times, as readers of long files like them.

    What is told of a frame comes after newer frames; where that is more than _LATEST_NS, or more than `room` bytes
    would have to wait, as of a clock that stands still, the order stays wrong.
    """
    waiting: list[tuple[int, int, Converted]] = []
    newest = held = 0
    for number, message in enumerate(messages):
        heapq.heappush(waiting, (message.log_ns, number, message))
        newest, held = max(newest, message.log_ns), held + len(message.payload)
        while waiting and (waiting[0][0] < newest - _LATEST_NS or held > room):
            oldest = heapq.heappop(waiting)[-1]
            held -= len(oldest.payload)
            yield oldest
    yield from (message for _, _, message in sorted(waiting))
