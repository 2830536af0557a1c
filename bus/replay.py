"""Reading recordings: their messages, what they hold, what a damaged one still has, and sending them again."""

from __future__ import annotations

import io
import os
import struct
import threading
import time
from collections.abc import Container, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import mcap.exceptions
from mcap import records
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.stream_reader import CRCValidationError, StreamReader
from mcap.writer import MCAP0_MAGIC

from fieldpose.bus.codec import decode
from fieldpose.bus.messages import Message
from fieldpose.bus.ports import Outbox
from fieldpose.bus.protocol import Bus
from fieldpose.bus.topics import Address, Topic, topic_of
from fieldpose.errors import CodecError, RecordingError

SOURCE_RECORD = "fieldpose.source"
RECORDING_RECORD = "fieldpose.recording"
SNAPSHOT_RECORD = "fieldpose.snapshot"
PART_RECORD = "fieldpose.part"
EXPECTED_RECORD = "fieldpose.expected"
"""Of a part that is not the first: "KEY SENDER" -> the number that this sender's next message should have."""
_RECORD_LIMIT = 1 << 30
_RECORD_HEAD, _CHUNK_HEAD = 9, 32
_DAMAGE = (
    mcap.exceptions.McapError, CRCValidationError, struct.error, EOFError, ValueError, KeyError, IndexError,
    OverflowError, MemoryError, StopIteration, RuntimeError,
)  # fmt: skip


class Recorded(NamedTuple):
    key: str
    topic: Topic
    message: Message
    log_time_ns: int


class Payload(NamedTuple):
    """A message as it stands in the file, not yet checked."""

    key: str
    data: bytes
    log_time_ns: int
    publish_ns: int = 0
    sequence: int = 0


class Kind(NamedTuple):
    """How a topic's messages are encoded, and the name, encoding and bytes of their schema."""

    encoding: str
    schema: tuple[str, str, bytes]


class Attachment(NamedTuple):
    name: str
    media_type: str
    data: bytes


@dataclass(frozen=True)
class TopicInfo:
    key: str
    topic: str
    messages: int
    first_ns: int
    last_ns: int
    rate_hz: float


@dataclass(frozen=True)
class SourceInfo:
    """`missing` did not reach the recorder; what is received and not written found its queue full.

    first, last: the sender's own numbers of what was received, None in files of older versions.
    """

    key: str
    source: str
    received: int
    written: int
    missing: int
    first: int | None = None
    last: int | None = None


@dataclass(frozen=True)
class RecordingInfo:
    """What a recording holds; `lossless` says that every message sent is in it, by the senders' own numbers."""

    path: str
    size_bytes: int
    messages: int
    first_ns: int
    last_ns: int
    lossless: bool
    topics: list[TopicInfo] = field(default_factory=list)
    sources: list[SourceInfo] = field(default_factory=list)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, int] = field(default_factory=dict)

    @property
    def ended(self) -> str | None:
        """Why nothing was written any more, where that was not the wish of whoever recorded."""
        return self.metadata.get(RECORDING_RECORD, {}).get("ended")

    def of(self, address: Address) -> RecordingInfo:
        """What of it belongs to one pipeline."""
        topics = [topic for topic in self.topics if address.covers(topic.key)]
        sources = [source for source in self.sources if address.covers(source.key)]
        return replace(self, topics=topics, sources=sources, messages=sum(topic.messages for topic in topics))


def read_recording(path: Path | str, topics: Container[Topic[Any]] | None = None) -> Iterator[Recorded]:
    """The messages of a recording in the order of their receipt, of `topics` alone where given.

    Raises RecordingError for a file that is no whole recording, or holds a message that is none of its topic.
    """
    for payload in _payloads(path):
        topic = topic_of(payload.key)
        if topic is None or (topics is not None and topic not in topics):
            continue
        try:
            message = decode(payload.data, topic.message_type, topic.max_bytes)
        except CodecError as error:
            raise RecordingError(f"{path}: a message on {payload.key} cannot be read: {error}") from error
        yield Recorded(payload.key, topic, message, payload.log_time_ns)


def recorded_at(path: Path | str, topic: Topic[Any], key: str, log_time_ns: int) -> Iterator[Recorded]:
    """The messages under a key that were received at a time. Raises RecordingError as read_recording does."""
    with _reader(path) as reader:
        for _, _, message in reader.iter_messages([key], starting_at=log_time_ns, ending_at=log_time_ns):
            try:
                yield Recorded(key, topic, decode(message.data, topic.message_type, topic.max_bytes), message.log_time)
            except CodecError as error:
                raise RecordingError(f"{path}: a message on {key} cannot be read: {error}") from error


def sources_in(path: Path | str) -> list[SourceInfo]:
    """What a recording says of each sender, without reading its messages. Raises RecordingError as `info` does."""
    with _reader(path) as reader:
        return [_source_info(record.metadata) for record in reader.iter_metadata() if record.name == SOURCE_RECORD]


def info(path: Path | str) -> RecordingInfo:
    """What a recording holds. Raises RecordingError for a file that is no whole recording."""
    times: dict[str, list[int]] = {}
    for payload in _payloads(path):
        times.setdefault(payload.key, []).append(payload.log_time_ns)
    with _reader(path) as reader:
        metadata = [(record.name, record.metadata) for record in reader.iter_metadata()]
        attachments = {record.name: len(record.data) for record in reader.iter_attachments()}
        sources = [_source_info(values) for name, values in metadata if name == SOURCE_RECORD]
    named = {name: values for name, values in metadata if name != SOURCE_RECORD}
    everything = [time_ns for key_times in times.values() for time_ns in key_times]
    return RecordingInfo(
        path=str(path),
        size_bytes=os.path.getsize(path),
        messages=len(everything),
        first_ns=min(everything, default=0),
        last_ns=max(everything, default=0),
        lossless=named.get(RECORDING_RECORD, {}).get("lossless") == "true",
        topics=[_topic_info(key, key_times) for key, key_times in sorted(times.items())],
        sources=sorted(sources, key=lambda source: (source.key, source.source)),
        metadata=named,
        attachments=attachments,
    )


def of_another_program(path: Path | str) -> str | None:
    """What an MCAP file holds that is no recording of ours, in words; None for one that is, or is empty or damaged.

    Raises RecordingError for a file that cannot be read as MCAP.
    """
    with _reader(path) as reader:
        summary, profile = reader.get_summary(), reader.get_header().profile
    if summary is None or not summary.channels or any(topic_of(c.topic) for c in summary.channels.values()):
        return None
    names = {record.id: record.name for record in summary.schemas.values()}
    held = {c.topic: names.get(c.schema_id, c.message_encoding) for c in summary.channels.values()}
    topics = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(held.items()))
    return f"a recording of {profile or 'another program'}, with {topics}"


def read_attachment(path: Path | str, name: str) -> bytes:
    """The bytes of an attachment. Raises RecordingError where there is none of that name."""
    with _reader(path) as reader:
        found = next((record.data for record in reader.iter_attachments() if record.name == name), None)
    if found is None:
        raise RecordingError(f"{path}: has no attachment {name!r}; `fieldpose info` lists what it has")
    return found


def replay(
    bus: Bus,
    path: Path | str,
    topics: Container[Topic[Any]],
    rate: float | None = 1.0,
    address: Address | None = None,
    source: str = "replay",
    stop: threading.Event | None = None,
) -> int:
    """Send the recorded messages of `topics` again and return how many.

    `rate` 2 is twice as fast as they came, None as fast as the bus takes them. Frame ids, passes and capture times
    stay; source, sequence and sending time are new. They go where they came from, or to `address`.
    """
    stop = stop or threading.Event()
    outboxes: dict[Address, Outbox] = {}
    sent, first_ns, started = 0, None, time.monotonic()
    for recorded in read_recording(path, topics):
        first_ns = recorded.log_time_ns if first_ns is None else first_ns
        due = started + ((recorded.log_time_ns - first_ns) / 1e9 / rate if rate else 0.0)
        if stop.wait(max(0.0, due - time.monotonic())):
            break
        target = address or recorded.topic.address_of(recorded.key) or Address()
        if target not in outboxes:
            outboxes[target] = Outbox(bus, target, source)
        outboxes[target].publish(recorded.topic, recorded.message)
        sent += 1
    return sent


@dataclass
class Salvage:
    """What can be read of a damaged recording, up to the damage: `damage` says what that was, None where none."""

    path: Path | str
    metadata: list[tuple[str, dict[str, str]]] = field(default_factory=list)
    attachments: list[Attachment] = field(default_factory=list)
    kinds: dict[str, Kind] = field(default_factory=dict)
    damage: str | None = None

    def payloads(self) -> Iterator[Payload]:
        """The messages in the order of the file; metadata and attachments are collected on the way.

        Raises RecordingError where the file cannot be opened or does not begin as a recording.
        """
        channels: dict[int, str] = {}
        try:
            with _open(self.path) as stream:
                if os.fstat(stream.fileno()).st_size < len(MCAP0_MAGIC):
                    raise mcap.exceptions.InvalidMagic("too short")
                yield from self._read(
                    StreamReader(stream, validate_crcs=True, record_size_limit=_RECORD_LIMIT), channels
                )
        except mcap.exceptions.InvalidMagic as error:
            raise RecordingError(f"{self.path}: is no recording (MCAP file)") from error
        except _DAMAGE as error:
            self.damage = str(error) or type(error).__name__
        if self.damage is not None:
            # What is whole within the chunk that the file ends in, which the reader gives as a whole or not at all.
            with suppress(*_DAMAGE), _open(self.path) as stream:
                inside = StreamReader(_ExactBytes(_cut_chunk(stream)), skip_magic=True, record_size_limit=_RECORD_LIMIT)
                yield from self._read(inside, channels)

    def _read(self, reader: StreamReader, channels: dict[int, str]) -> Iterator[Payload]:
        schemas: dict[int, tuple[str, str, bytes]] = {}
        for record in reader.records:
            if isinstance(record, records.Schema):
                schemas[record.id] = (record.name, record.encoding, record.data)
            elif isinstance(record, records.Channel):
                channels[record.id] = record.topic
                # The schema stands before it, but not once more in the chunk that a file ends in.
                if record.schema_id in schemas:
                    self.kinds[record.topic] = Kind(record.message_encoding, schemas[record.schema_id])
            elif isinstance(record, records.Message):
                key, data = channels[record.channel_id], record.data
                yield Payload(key, data, record.log_time, record.publish_time, record.sequence)
            elif isinstance(record, records.Metadata):
                self.metadata.append((record.name, record.metadata))
            elif isinstance(record, records.Attachment):
                self.attachments.append(Attachment(record.name, record.media_type, record.data))


def _cut_chunk(stream: BinaryIO) -> bytes:
    """The records in an uncompressed chunk that goes on beyond the end of the file; none where it ends elsewhere.

    Source: MCAP's specification, of a record: opcode (1 byte), length (8), and of a chunk: two times and a size (8
    each), a checksum (4), the compression's name with its length (4), the length of the records (8).
    """
    size = os.fstat(stream.fileno()).st_size
    at = len(MCAP0_MAGIC)
    while True:
        stream.seek(at)
        opcode, length = struct.unpack("<BQ", stream.read(_RECORD_HEAD))
        if at + _RECORD_HEAD + length > size:
            break
        at += _RECORD_HEAD + length
    if opcode != Opcode.CHUNK:
        return b""
    _, _, _, _, name = struct.unpack("<QQQLL", stream.read(_CHUNK_HEAD))
    stream.read(8)
    return b"" if name else stream.read(min(size - stream.tell(), _RECORD_LIMIT))


class _ExactBytes(io.BytesIO):
    """Refuses to read past the end."""

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        if size is not None and len(data) < size:
            raise EOFError("the file ends within a record")
        return data


class _ExactReader(io.BufferedReader):
    """Refuses to read past the end, where a plain file gives less than was asked for."""

    def read(self, size: int | None = -1, /) -> bytes:
        if size is None or size < 0:
            return super().read(size)
        # A damaged length is refused before memory is taken for it.
        if size > io.DEFAULT_BUFFER_SIZE and size > os.fstat(self.fileno()).st_size - self.tell():
            raise EOFError("the file ends within a record")
        data = super().read(size)
        if len(data) < size:
            raise EOFError("the file ends within a record")
        return data


def _open(path: Path | str) -> _ExactReader:
    try:
        return _ExactReader(io.FileIO(path))
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from error


@contextmanager
def _reader(path: Path | str) -> Iterator[SeekingReader]:
    with _open(path) as stream:
        try:
            yield SeekingReader(stream, validate_crcs=True, record_size_limit=_RECORD_LIMIT)
        except mcap.exceptions.InvalidMagic as error:
            raise RecordingError(f"{path}: is no recording (MCAP file)") from error
        except (*_DAMAGE, OSError) as error:
            detail = " ".join(str(error).split()) or type(error).__name__
            hint = "`fieldpose recover` saves what is in it"
            raise RecordingError(f"{path}: is not a whole recording ({detail}); {hint}") from error


def _payloads(path: Path | str) -> Iterator[Payload]:
    with _reader(path) as reader:
        for _, channel, message in reader.iter_messages():
            yield Payload(channel.topic, message.data, message.log_time)


def _topic_info(key: str, times: list[int]) -> TopicInfo:
    topic = topic_of(key)
    first, last = min(times), max(times)
    rate_hz = (len(times) - 1) / ((last - first) / 1e9) if last > first else 0.0
    return TopicInfo(key, topic.name if topic else "", len(times), first, last, rate_hz)


def _source_info(values: dict[str, str]) -> SourceInfo:
    counts = (int(values[name]) for name in ("received", "written", "missing"))
    ends = (int(values[name]) if name in values else None for name in ("first", "last"))
    return SourceInfo(values["key"], values["source"], *counts, *ends)
