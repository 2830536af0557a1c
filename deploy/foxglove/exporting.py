"""A recording as a file of Foxglove's schemas."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from fieldpose.bus.foreign import ForeignWriter
from fieldpose.bus.replay import read_recording
from fieldpose.bus.topics import Address
from fieldpose.deploy.foxglove.channels import ALL
from fieldpose.deploy.foxglove.converter import Converter
from fieldpose.deploy.reporting.trajectories import in_words
from fieldpose.stages.nerf.metadata import FieldMetadata

RECORD = "fieldpose"


def export(recording: Path, out: Path, address: Address, field: FieldMetadata | None) -> dict[str, int]:
    """Write one pipeline of a recording; returns topic -> number of messages, of all topics.

    Messages have their frame's capture time as log time, and the time of their being sent as publish time. True poses
    are written where the field is known. Raises RecordingError and OutputError.
    """
    converter = Converter(object_from_dataset=None if field is None else field.frame.object_from_dataset)
    counts: Counter[str] = Counter({channel.topic: 0 for channel in ALL})
    with ForeignWriter(out) as writer:
        for channel in ALL:
            writer.channel(channel.topic, channel.encoding, channel.schema)
        for recorded in read_recording(recording):
            if not address.covers(recorded.key):
                continue
            for message in converter.convert(recorded.topic, recorded.message):
                topic = message.channel.topic
                writer.write(topic, message.payload, message.log_ns, message.publish_ns, message.sequence)
                counts[topic] += 1
        about = {"recording": recording.name, "object": address.object, "camera": address.camera}
        writer.add(RECORD, {**about, "lengths": in_words(field)})
    return dict(counts)
