"""A pipeline recorded straight into Foxglove's schemas."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fieldpose.bus.codec import decode
from fieldpose.bus.foreign import ForeignRecording
from fieldpose.bus.mcap_files import RECORDING_RECORD
from fieldpose.bus.messages import Header
from fieldpose.bus.ports import Sequences
from fieldpose.bus.splitting import OpenPart
from fieldpose.bus.topics import Address, Topic
from fieldpose.deploy.foxglove.channels import ALL
from fieldpose.deploy.foxglove.converter import Converter
from fieldpose.deploy.foxglove.exporting import RECORD, about
from fieldpose.errors import CodecError, OutputError, RecordingError
from fieldpose.stages.nerf.metadata import FieldMetadata


class FoxgloveRecording(ForeignRecording):
    """A recorder's store, of one pipeline: what `exporting.export` writes, in the order in which it was received.

    before: the part that this one goes on with, if any. Raises RecordingError where nothing can be written.
    """

    def __init__(
        self,
        path: Path,
        address: Address,
        field: FieldMetadata | None,
        from_start: bool = False,
        before: FoxgloveRecording | None = None,
        resume: bool = False,
    ) -> None:
        self.refused = self.unwritten = self.doubted = 0
        self._address = address
        moved = None if field is None else field.frame.object_from_dataset
        self._converter: Converter = Converter(object_from_dataset=moved) if before is None else before._converter
        self._sequences: Sequences = Sequences(from_start, None if before is None else before._sequences.expected)
        super().__init__(path, resume)
        # What was sent while nobody recorded cannot be counted: these messages have no numbers of their senders.
        self._lossless = self._before is None
        try:
            for channel in ALL:
                self.channel(channel.topic, channel.encoding, channel.schema)
            self.add(RECORD, about(path.name, address, field))
            self.flush()
        except (OSError, RecordingError) as error:
            self.discard()
            raise self._unwritable(error) if isinstance(error, OSError) else error from error

    def write_payload(self, key: str, topic: Topic[Any], payload: bytes, log_time_ns: int) -> None:
        """Convert bytes from the wire; those that are no message of this pipeline's are counted, or left out."""
        if not self._address.covers(key):
            return
        try:
            message = decode(payload, topic.message_type, topic.max_bytes)
            converted = list(self._converter.convert(topic, message))
        except (CodecError, OutputError):
            self.refused += 1
            return
        self._sequences.seen(key, message.header)
        for each in converted:
            self.write(each.channel.topic, each.payload, each.log_ns, each.publish_ns, each.sequence)

    def note_dropped(self, key: str, header: Header) -> None:
        """Count a message that was received and is not written."""
        self._sequences.seen(key, header)
        self.unwritten += 1

    def note_left_out(self, refused: int, doubted: int) -> None:
        """Count what was no message, and what was by nobody who is believed."""
        self.refused += refused
        self.doubted += doubted

    def close(self, damage: str | None = None, ended: str | None = None) -> bool:
        missing = sum(self._sequences.missing.values())
        lossless = self._lossless and not (missing or self.unwritten or self.refused or damage or ended)
        counts = {"missing": missing, "unwritten": self.unwritten, "refused": self.refused, "doubted": self.doubted}
        noted = {"lossless": str(lossless).lower(), **{name: str(count) for name, count in counts.items()}}
        whys = {name: why for name, why in {"damage": damage, "ended": ended}.items() if why}
        self.add(RECORDING_RECORD, noted | whys)
        self._finish()
        return lossless


def foxglove_parts(address: Address, field: FieldMetadata | None, from_start: bool) -> OpenPart:
    """Opens files of one pipeline in Foxglove's schemas; true poses are there where its field is known."""

    def open_part(path: Path, number: int, before: FoxgloveRecording | None, resume: bool) -> FoxgloveRecording:
        return FoxgloveRecording(path, address, field, from_start, before, resume)

    return open_part
