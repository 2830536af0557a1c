"""Writing recordings: every message as it came, and at the end what each sender's numbers say is missing."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
from mcap.writer import CompressionType, Writer

from fieldpose.bus.codec import decode, encode
from fieldpose.bus.messages import Header, Message
from fieldpose.bus.ports import Sequences
from fieldpose.bus.replay import RECORDING_RECORD, SOURCE_RECORD, Attachment, Salvage
from fieldpose.bus.topics import Topic, topic_of
from fieldpose.errors import CodecError, RecordingError

_CHUNK_BYTES = 2 << 20
_FLUSH_S = 1.0

Metadata = Mapping[str, Mapping[str, str]]


def partial_path(path: Path | str) -> Path:
    """Where a recording stands until it is closed."""
    return Path(f"{path}.partial")


@dataclass
class _Tally:
    received: int = 0
    written: int = 0


class RecordingWriter:
    """Writes one recording: into PATH.partial, which a kill leaves fit for `recover`, renamed to PATH by `close`.

    An unfinished recording of that name is in the way, unless `resume` says to go on with what can be saved of it.
    With `from_start` a sender's first message is its number 0, and what is before the first one seen is missing.
    Raises RecordingError where nothing can be written.
    """

    def __init__(
        self,
        path: Path | str,
        metadata: Metadata | None = None,
        attachments: Iterable[Attachment] = (),
        resume: bool = False,
        from_start: bool = False,
    ) -> None:
        self.path = Path(path)
        self.refused = 0
        self.messages = 0
        self._partial = partial_path(path)
        self._channels: dict[str, int] = {}
        self._schemas: dict[type[Message], int] = {}
        self._sequences = Sequences(from_start)
        self._tallies: dict[tuple[str, str], _Tally] = {}
        self._flushed = time.monotonic()
        before = self._set_aside(resume)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._stream = open(self._partial, "wb")  # noqa: SIM115 - closed by `close`
        except OSError as error:
            raise RecordingError(f"{self._partial}: cannot be written: {error.strerror}") from error
        self._writer = Writer(self._stream, chunk_size=_CHUNK_BYTES, compression=CompressionType.NONE)
        self._writer.start(profile="fieldpose")
        self.add(metadata, attachments)
        if before is not None:
            self.copy(Salvage(before))
        self.flush()
        if before is not None:
            before.unlink()

    def add(self, metadata: Metadata | None = None, attachments: Iterable[Attachment] = ()) -> None:
        """Put in metadata (name -> key -> value) and attachments."""
        now_ns = time.time_ns()
        for name, values in (metadata or {}).items():
            self._writer.add_metadata(name, dict(values))
        for attachment in attachments:
            self._writer.add_attachment(now_ns, now_ns, attachment.name, attachment.media_type, attachment.data)

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
        self._put(key, topic, payload, header, log_time_ns)

    def copy(self, salvage: Salvage) -> int:
        """Write every message that can be saved of another file; return their number."""
        before = self.messages
        for payload in salvage.payloads():
            topic = topic_of(payload.key)
            if topic is not None:
                self.write_payload(payload.key, topic, payload.data, payload.log_time_ns)
        return self.messages - before

    def note_dropped(self, key: str, header: Header) -> None:
        """Count a message that was received and is not written."""
        self._sequences.seen(key, header)
        self._tally(key, header).received += 1

    def close(self, damage: str | None = None) -> bool:
        """Finish the file and give it its name; return whether it is lossless. `damage` says why it cannot be."""
        lossless = self._write_counts(damage)
        self._writer.finish()
        self._stream.flush()
        os.fsync(self._stream.fileno())
        self._stream.close()
        os.replace(self._partial, self.path)
        return lossless

    def discard(self) -> None:
        """Give up what was written."""
        self._stream.close()
        self._partial.unlink()

    def _put(self, key: str, topic: Topic[Any], payload: bytes, header: Header, log_time_ns: int) -> None:
        self._sequences.seen(key, header)
        tally = self._tally(key, header)
        tally.received += 1
        tally.written += 1
        self.messages += 1
        channel = self._channels.get(key) or self._register(key, topic)
        self._writer.add_message(channel, log_time_ns, payload, header.sent_ns, header.sequence % 2**32)
        self.flush_if_due()

    def flush_if_due(self) -> float:
        """Flush once a second, to be called also while nothing comes; return the seconds until the next time."""
        if time.monotonic() - self._flushed >= _FLUSH_S:
            self.flush()
        return max(0.0, self._flushed + _FLUSH_S - time.monotonic())

    def flush(self) -> None:
        """Hand what was written to the operating system, so that a kill of this process does not lose it."""
        self._writer.flush()
        self._flushed = time.monotonic()

    def _tally(self, key: str, header: Header) -> _Tally:
        return self._tallies.setdefault((key, header.source), _Tally())

    def _register(self, key: str, topic: Topic[Any]) -> int:
        if topic.message_type not in self._schemas:
            schema = schema_of(topic.message_type)
            self._schemas[topic.message_type] = self._writer.register_schema(
                topic.message_type.__name__, "jsonschema", schema
            )
        schema_id = self._schemas[topic.message_type]
        self._channels[key] = self._writer.register_channel(key, "msgpack", schema_id)
        return self._channels[key]

    def _write_counts(self, damage: str | None) -> bool:
        lossless = self.refused == 0 and damage is None
        for (key, source), tally in sorted(self._tallies.items()):
            missing = self._sequences.missing.get((key, source), 0)
            lossless = lossless and missing == 0 and tally.written == tally.received
            counts = {"received": tally.received, "written": tally.written, "missing": missing}
            values = {"key": key, "source": source, **{name: str(count) for name, count in counts.items()}}
            self._writer.add_metadata(SOURCE_RECORD, values)
        values = {"lossless": str(lossless).lower(), "refused": str(self.refused)}
        self._writer.add_metadata(RECORDING_RECORD, values | ({"damage": damage} if damage else {}))
        return lossless

    def _set_aside(self, resume: bool) -> Path | None:
        aside = self._partial.with_name(self._partial.name + ".before")
        # Killed before its first flush, a recording has nothing at all.
        unfinished = self._partial.exists() and self._partial.stat().st_size > 0
        if not resume and (unfinished or aside.exists()):
            raise RecordingError(
                f"{self._partial}: an unfinished recording is in the way; `fieldpose recover` it, or remove it"
            )
        # A file set aside already is one whose taking over was itself interrupted: it has the older messages.
        if unfinished and not aside.exists():
            os.replace(self._partial, aside)
        return aside if aside.exists() else None


def schema_of(message_type: type[Message]) -> bytes:
    """The JSON schema of a message type's fields, with arrays as they are packed."""
    array = {
        "type": "object",
        "description": "little-endian, row-major",
        "properties": {"dtype": {"type": "string"}, "shape": {"type": "array"}, "data": {"type": "string"}},
        "required": ["dtype", "shape", "data"],
    }
    return msgspec.json.encode(msgspec.json.schema(message_type, schema_hook=lambda _: array))


def recover(path: Path | str, out: Path | str) -> int:
    """Write what can be saved of an unfinished or damaged recording as a whole one; return the number of messages.

    Raises RecordingError where `path` does not begin as a recording, holds no message, or nothing can be written.
    """
    salvage = Salvage(path)
    writer = RecordingWriter(out)
    try:
        saved = writer.copy(salvage)
    except RecordingError:
        writer.discard()
        raise
    if saved == 0:
        writer.discard()
        why = "" if salvage.damage is None else f" ({salvage.damage})"
        raise RecordingError(f"{path}: no whole message is in it{why}; nothing was written")
    named = {name: values for name, values in salvage.metadata if name not in (SOURCE_RECORD, RECORDING_RECORD)}
    writer.add(named, salvage.attachments)
    writer.close(damage=salvage.damage)
    return saved
