"""Writing recordings: every message as it came, and at the end what each sender's numbers say is missing."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import msgspec
from mcap.writer import CompressionType

from fieldpose.bus.codec import decode, encode
from fieldpose.bus.mcap_files import RECORDING_RECORD, SOURCE_RECORD, Attachment
from fieldpose.bus.messages import Header, Message
from fieldpose.bus.open_recording import OpenRecording
from fieldpose.bus.ports import Sequences
from fieldpose.bus.salvage import Salvage
from fieldpose.bus.senders import KEPT
from fieldpose.bus.topics import Topic, topic_of
from fieldpose.errors import CodecError

_MOST_KEYS = 4096
"""More than all topics of a hundred pipelines; MCAP has numbers for 65535."""
_OTHERS = "(others)"
"""Counts together the senders beyond those of which each is counted."""

Metadata = Mapping[str, Mapping[str, str]]


@dataclass
class _Tally:
    first: int
    last: int = 0
    received: int = 0
    written: int = 0
    missing: int = 0


class RecordingWriter(OpenRecording):
    """Writes one recording of fieldpose's own messages.

    With `from_start` a sender's first message is its number 0, and what is before the first one seen is missing;
    expected: by key and sender, the number of the first where this recording goes on with another.
    """

    def __init__(
        self,
        path: Path | str,
        metadata: Metadata | None = None,
        attachments: Iterable[Attachment] = (),
        resume: bool = False,
        from_start: bool = False,
        expected: Mapping[tuple[str, str], int] | None = None,
    ) -> None:
        self.refused = 0
        self.doubted = 0
        self._channels: dict[str, int] = {}
        self._schemas: dict[type[Message], int] = {}
        self._sequences = Sequences(from_start, expected)
        self._tallies: dict[tuple[str, str], _Tally] = {}
        super().__init__(path, "fieldpose", CompressionType.NONE, resume)
        try:
            self.add(metadata, attachments)
            self.flush()
        except OSError as error:
            self.discard()
            raise self._unwritable(error) from error

    @property
    def expected(self) -> dict[tuple[str, str], int]:
        """By key and sender, the number that its next message should have."""
        return self._sequences.expected

    def add(self, metadata: Metadata | None = None, attachments: Iterable[Attachment] = ()) -> None:
        """Put in metadata (name -> key -> value) and attachments."""
        now_ns = time.time_ns()
        for name, values in (metadata or {}).items():
            self._writer.add_metadata(name, dict(values))
        for attachment in attachments:
            self._writer.add_attachment(now_ns, now_ns, attachment.name, attachment.media_type, attachment.data)
            self.size += len(attachment.data)
        self._check_room()

    def write(self, key: str, topic: Topic[Any], message: Message, log_time_ns: int) -> None:
        """Write a message under its own header."""
        self._put(key, topic, encode(message), message.header, log_time_ns)

    def write_payload(self, key: str, topic: Topic[Any], payload: bytes, log_time_ns: int) -> None:
        """Write bytes from the wire as they are; those that are no message are refused and counted."""
        try:
            header = decode(payload, topic.message_type, topic.max_bytes).header
        except CodecError:
            self.refused += 1
            return
        if key not in self._channels and len(self._channels) >= _MOST_KEYS:
            self.refused += 1
            return
        self._put(key, topic, payload, header, log_time_ns)

    def copy(self, salvage: Salvage) -> int:
        before = self.messages
        for payload in salvage.payloads():
            topic = topic_of(payload.key)
            if topic is not None:
                self.write_payload(payload.key, topic, payload.data, payload.log_time_ns)
        return self.messages - before

    def note_dropped(self, key: str, header: Header) -> None:
        """Count a message that was received and is not written."""
        self._count(key, header).received += 1

    def note_left_out(self, refused: int, doubted: int) -> None:
        """Count what was no message, and what was by nobody who is believed."""
        self.refused += refused
        self.doubted += doubted

    def close(self, damage: str | None = None, ended: str | None = None) -> bool:
        lossless = self._write_counts({"damage": damage, "ended": ended})
        self._finish()
        return lossless

    def _put(self, key: str, topic: Topic[Any], payload: bytes, header: Header, log_time_ns: int) -> None:
        tally = self._count(key, header)
        tally.received += 1
        tally.written += 1
        channel = self._channels.get(key) or self._register(key, topic)
        self._add_message(channel, log_time_ns, payload, header.sent_ns, header.sequence)

    def _count(self, key: str, header: Header) -> _Tally:
        missing = self._sequences.seen(key, header)
        sender = (key, header.source)
        if sender not in self._tallies and len(self._tallies) >= KEPT:
            sender = (key, _OTHERS)
        tally = self._tallies.setdefault(sender, _Tally(header.sequence))
        tally.missing += missing
        tally.last = header.sequence
        return tally

    def _register(self, key: str, topic: Topic[Any]) -> int:
        if topic.message_type not in self._schemas:
            schema = schema_of(topic.message_type)
            self._schemas[topic.message_type] = self._writer.register_schema(
                topic.message_type.__name__, "jsonschema", schema
            )
        schema_id = self._schemas[topic.message_type]
        self._channels[key] = self._writer.register_channel(key, "msgpack", schema_id)
        return self._channels[key]

    def _write_counts(self, whys: Mapping[str, str | None]) -> bool:
        """Write what each sender's numbers say; return whether the file is lossless, and there is no reason why not."""
        noted = {name: why for name, why in whys.items() if why}
        lossless = self.refused == 0 and not noted
        for (key, source), tally in sorted(self._tallies.items()):
            lossless = lossless and tally.missing == 0 and tally.written == tally.received
            counts = {name: str(count) for name, count in asdict(tally).items()}
            self._writer.add_metadata(SOURCE_RECORD, {"key": key, "source": source, **counts})
        values = {"lossless": str(lossless).lower(), "refused": str(self.refused)}
        if self.doubted:
            values["doubted"] = str(self.doubted)
        self._writer.add_metadata(RECORDING_RECORD, values | noted)
        return lossless


def schema_of(message_type: type[Message]) -> bytes:
    """The JSON schema of a message type's fields, with arrays as they are packed."""
    array = {
        "type": "object",
        "description": "little-endian, row-major",
        "properties": {"dtype": {"type": "string"}, "shape": {"type": "array"}, "data": {"type": "string"}},
        "required": ["dtype", "shape", "data"],
    }
    return msgspec.json.encode(msgspec.json.schema(message_type, schema_hook=lambda _: array))
