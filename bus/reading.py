"""Reading recordings: their messages, and what they hold."""

from __future__ import annotations

import os
import struct
from collections.abc import Container, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.reader import Summary

from fieldpose.bus.codec import decode
from fieldpose.bus.mcap_files import DAMAGE, RECORDING_RECORD, SOURCE_RECORD, Payload, open_file, reader_of
from fieldpose.bus.messages import Message
from fieldpose.bus.topics import Address, Topic, topic_of
from fieldpose.errors import CodecError, RecordingError

_INDEX_HEAD = 15


class Recorded(NamedTuple):
    key: str
    topic: Topic
    message: Message
    log_time_ns: int


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
    with reader_of(path) as reader:
        for _, _, message in reader.iter_messages([key], starting_at=log_time_ns, ending_at=log_time_ns):
            try:
                yield Recorded(key, topic, decode(message.data, topic.message_type, topic.max_bytes), message.log_time)
            except CodecError as error:
                raise RecordingError(f"{path}: a message on {key} cannot be read: {error}") from error


def sources_in(path: Path | str) -> list[SourceInfo]:
    """What a recording says of each sender, without reading its messages. Raises RecordingError as `info` does."""
    with reader_of(path) as reader:
        return [_source_info(record.metadata) for record in reader.iter_metadata() if record.name == SOURCE_RECORD]


def info(path: Path | str) -> RecordingInfo:
    """What a recording holds, as its own index says; of a file that has none of all messages, as they are read.

    Raises RecordingError for a file that is no whole recording. Damage within messages is found only by reading them.
    """
    with reader_of(path) as reader:
        summary = reader.get_summary()
        metadata = [(record.name, record.metadata) for record in reader.iter_metadata()]
        attachments = {record.name: len(record.data) for record in reader.iter_attachments()}
        sources = [_source_info(values) for name, values in metadata if name == SOURCE_RECORD]
    named = {name: values for name, values in metadata if name != SOURCE_RECORD}
    spans = _indexed_spans(path, summary)
    if spans is None:
        spans = _read_spans(path)
    return RecordingInfo(
        path=str(path),
        size_bytes=os.path.getsize(path),
        messages=sum(span.messages for span in spans.values()),
        first_ns=min((span.first_ns for span in spans.values()), default=0),
        last_ns=max((span.last_ns for span in spans.values()), default=0),
        lossless=named.get(RECORDING_RECORD, {}).get("lossless") == "true",
        topics=[_topic_info(key, span) for key, span in sorted(spans.items())],
        sources=sorted(sources, key=lambda source: (source.key, source.source)),
        metadata=named,
        attachments=attachments,
    )


def of_another_program(path: Path | str) -> str | None:
    """What an MCAP file holds that is no recording of ours, in words; None for one that is, or is empty or damaged.

    Raises RecordingError for a file that cannot be read as MCAP.
    """
    with reader_of(path) as reader:
        summary, profile = reader.get_summary(), reader.get_header().profile
    if summary is None or not summary.channels or any(topic_of(c.topic) for c in summary.channels.values()):
        return None
    names = {record.id: record.name for record in summary.schemas.values()}
    held = {c.topic: names.get(c.schema_id, c.message_encoding) for c in summary.channels.values()}
    topics = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(held.items()))
    return f"a recording of {profile or 'another program'}, with {topics}"


def read_attachment(path: Path | str, name: str) -> bytes:
    """The bytes of an attachment. Raises RecordingError where there is none of that name."""
    with reader_of(path) as reader:
        found = next((record.data for record in reader.iter_attachments() if record.name == name), None)
    if found is None:
        raise RecordingError(f"{path}: has no attachment {name!r}; `fieldpose info` lists what it has")
    return found


def _payloads(path: Path | str) -> Iterator[Payload]:
    with reader_of(path) as reader:
        for _, channel, message in reader.iter_messages():
            yield Payload(channel.topic, message.data, message.log_time)


class _Span(NamedTuple):
    messages: int
    first_ns: int
    last_ns: int

    def with_times(self, messages: int, first_ns: int, last_ns: int) -> _Span:
        return _Span(self.messages + messages, min(self.first_ns, first_ns), max(self.last_ns, last_ns))


def _read_spans(path: Path | str) -> dict[str, _Span]:
    spans: dict[str, _Span] = {}
    for payload in _payloads(path):
        at_ns = payload.log_time_ns
        spans[payload.key] = spans.get(payload.key, _Span(0, at_ns, at_ns)).with_times(1, at_ns, at_ns)
    return spans


def _indexed_spans(path: Path | str, summary: Summary | None) -> dict[str, _Span] | None:
    """By key, from the indexes behind the chunks; None where they do not have every message that was counted.

    Source: MCAP's specification, of a message index: opcode (1 byte), length (8), channel (2), bytes of entries (4),
    and of each entry: log time, offset (8 each).
    """
    if summary is None or summary.statistics is None:
        return None
    spans: dict[str, _Span] = {}
    try:
        with open_file(path) as stream:
            for chunk in summary.chunk_indexes:
                start = chunk.chunk_start_offset + chunk.chunk_length
                stream.seek(start)
                block = stream.read(chunk.message_index_length)
                for channel, offset in chunk.message_index_offsets.items():
                    at = offset - start
                    opcode, _, its_channel, size = struct.unpack_from("<BQHL", block, at)
                    if (opcode, its_channel) != (Opcode.MESSAGE_INDEX, channel):
                        return None
                    times = np.frombuffer(block, "<u8", size // 8, at + _INDEX_HEAD)[::2]
                    if not times.size:
                        continue
                    key, first, last = summary.channels[channel].topic, int(times.min()), int(times.max())
                    spans[key] = spans.get(key, _Span(0, first, last)).with_times(times.size, first, last)
    except (*DAMAGE, OSError):
        return None
    return spans if sum(span.messages for span in spans.values()) == summary.statistics.message_count else None


def _topic_info(key: str, span: _Span) -> TopicInfo:
    topic = topic_of(key)
    messages, first, last = span
    rate_hz = (messages - 1) / ((last - first) / 1e9) if last > first else 0.0
    return TopicInfo(key, topic.name if topic else "", messages, first, last, rate_hz)


def _source_info(values: dict[str, str]) -> SourceInfo:
    counts = (int(values[name]) for name in ("received", "written", "missing"))
    ends = (int(values[name]) if name in values else None for name in ("first", "last"))
    return SourceInfo(values["key"], values["source"], *counts, *ends)
