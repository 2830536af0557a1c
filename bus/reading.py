"""Reading recordings: their messages, and what they hold."""

from __future__ import annotations

import os
from collections.abc import Container, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from fieldpose.bus.codec import decode
from fieldpose.bus.mcap_files import RECORDING_RECORD, SOURCE_RECORD, Payload, reader_of
from fieldpose.bus.messages import Message
from fieldpose.bus.topics import Address, Topic, topic_of
from fieldpose.errors import CodecError, RecordingError


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
    """What a recording holds. Raises RecordingError for a file that is no whole recording."""
    times: dict[str, list[int]] = {}
    for payload in _payloads(path):
        times.setdefault(payload.key, []).append(payload.log_time_ns)
    with reader_of(path) as reader:
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


def _topic_info(key: str, times: list[int]) -> TopicInfo:
    topic = topic_of(key)
    first, last = min(times), max(times)
    rate_hz = (len(times) - 1) / ((last - first) / 1e9) if last > first else 0.0
    return TopicInfo(key, topic.name if topic else "", len(times), first, last, rate_hz)


def _source_info(values: dict[str, str]) -> SourceInfo:
    counts = (int(values[name]) for name in ("received", "written", "missing"))
    ends = (int(values[name]) if name in values else None for name in ("first", "last"))
    return SourceInfo(values["key"], values["source"], *counts, *ends)
