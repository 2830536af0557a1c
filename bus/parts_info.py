"""What the parts of a recording hold together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from fieldpose.bus.reading import RecordingInfo, SourceInfo, TopicInfo


def joined(parts: Sequence[RecordingInfo]) -> RecordingInfo | None:
    """What the parts of a recording hold together, under the name of the last; None without any."""
    if not parts:
        return None
    topics: dict[str, list[TopicInfo]] = {}
    sources: dict[tuple[str, str], list[SourceInfo]] = {}
    for part in parts:
        for topic in part.topics:
            topics.setdefault(topic.key, []).append(topic)
        for source in part.sources:
            sources.setdefault((source.key, source.source), []).append(source)
    return replace(
        parts[-1],
        size_bytes=sum(part.size_bytes for part in parts),
        messages=sum(part.messages for part in parts),
        first_ns=min((part.first_ns for part in parts if part.messages), default=0),
        last_ns=max(part.last_ns for part in parts),
        lossless=all(part.lossless for part in parts),
        topics=[_joined_topic(those) for _, those in sorted(topics.items())],
        sources=[_joined_source(those) for _, those in sorted(sources.items())],
    )


def _joined_topic(parts: Sequence[TopicInfo]) -> TopicInfo:
    messages, first, last = sum(p.messages for p in parts), parts[0].first_ns, parts[-1].last_ns
    rate_hz = (messages - 1) / ((last - first) / 1e9) if last > first else 0.0
    return replace(parts[0], messages=messages, first_ns=first, last_ns=last, rate_hz=rate_hz)


def _joined_source(parts: Sequence[SourceInfo]) -> SourceInfo:
    counts = {name: sum(getattr(part, name) for part in parts) for name in ("received", "written", "missing")}
    return replace(parts[0], **counts, last=parts[-1].last)
