"""What the parts of a recording hold together."""

from __future__ import annotations

from pathlib import Path

from support.bus_samples import ADDRESS, every_message

from fieldpose.bus.codec import encode
from fieldpose.bus.messages import Header
from fieldpose.bus.parts_info import joined
from fieldpose.bus.reading import info, sources_in
from fieldpose.bus.splitting import Split, SplitWriter, native_parts, part_path
from fieldpose.bus.topics import STATE, TRUTH

SECOND = 1_000_000_000


def test_counts_add_up_and_times_span_all(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    writer = SplitWriter(path, Split(seconds=5.0), native_parts(from_start=True))
    for number, at in ((0, 1), (1, 2), (4, 7), (5, 8)):
        for topic in (STATE, TRUTH) if number < 4 else (STATE,):
            message = every_message()[topic]
            message.header = Header("tracking", number, number, 0, number, number)
            writer.write_payload(ADDRESS.key(topic), topic, encode(message), at * SECOND)
    assert not writer.close()
    parts = [info(part_path(path, number)) for number in range(2)]
    whole = joined(parts)
    assert whole is not None
    assert (whole.messages, whole.first_ns, whole.last_ns, whole.lossless) == (6, 1 * SECOND, 8 * SECOND, False)
    assert whole.size_bytes == sum(part.size_bytes for part in parts)
    topics = {topic.topic: (topic.messages, topic.rate_hz) for topic in whole.topics}
    assert topics == {"state": (4, 3 / 7), "truth": (2, 1.0)}
    sources = {source.key: (source.received, source.missing, source.first, source.last) for source in whole.sources}
    assert sources == {ADDRESS.key(STATE): (4, 2, 0, 5), ADDRESS.key(TRUTH): (2, 0, 0, 1)}
    assert sources_in(part_path(path, 1)) == parts[1].sources
    assert joined([]) is None
