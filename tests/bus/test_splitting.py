"""A recording in parts: each is whole, and what each sender's numbers say goes on from one to the next."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from support.bus_samples import ADDRESS, frame

from fieldpose.bus.codec import encode
from fieldpose.bus.mcap_files import EXPECTED_RECORD, PART_RECORD, Attachment
from fieldpose.bus.messages import Header
from fieldpose.bus.open_recording import partial_path
from fieldpose.bus.reading import info, read_recording
from fieldpose.bus.recording import RecordingWriter
from fieldpose.bus.splitting import Split, SplitWriter, native_parts, part_path, parts_of
from fieldpose.bus.topics import FRAME
from fieldpose.errors import RecordingError

KEY = ADDRESS.key(FRAME)
PARTS = native_parts({"run": {"id": "7"}}, [Attachment("field", "x/y", b"abc")], from_start=True)
SIZE = 100 * 75 * 3


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run.mcap"


def payload(number: int) -> bytes:
    return encode(frame(number, 100, 75, Header("camera", number, number, 0, number, number)))


def write(writer: SplitWriter, numbers: range) -> None:
    for number in numbers:
        writer.write_payload(KEY, FRAME, payload(number), number * 100_000_000)


def numbers_of(part: Path) -> list[int]:
    return [each.message.header.sequence for each in read_recording(part)]


@pytest.mark.parametrize(
    "split", [Split(max_bytes=5 * SIZE), Split(seconds=0.5), Split(max_bytes=50 * SIZE, seconds=0.5)]
)
def test_parts_are_whole_and_go_on_with_each_other(path: Path, split: Split) -> None:
    writer = SplitWriter(path, split, PARTS)
    write(writer, range(17))
    assert writer.close()
    parts = [part_path(path, number) for number in range(4)]
    assert sorted(path.parent.iterdir()) == parts
    assert writer.messages == 17
    assert [numbers_of(part) for part in parts] == [[*range(at, min(at + 5, 17))] for at in (0, 5, 10, 15)]
    for number, part in enumerate(parts):
        facts = info(part)
        (source,) = facts.sources
        assert facts.lossless
        assert (source.missing, source.first) == (0, 5 * number)
        assert facts.metadata["run"] == {"id": "7"}
        assert facts.attachments == {"field": 3}
        if number:
            assert facts.metadata[PART_RECORD] == {"part": str(number), "before": parts[number - 1].name}
            assert facts.metadata[EXPECTED_RECORD] == {
                f"{KEY} camera": str(info(parts[number - 1]).sources[0].last + 1)
            }


def test_what_is_lost_between_parts_is_missing_in_the_later_one(path: Path) -> None:
    writer = SplitWriter(path, Split(seconds=0.5), PARTS)
    write(writer, range(5))
    write(writer, range(8, 11))
    assert not writer.close()
    assert info(part_path(path, 0)).lossless
    assert [source.missing for source in info(part_path(path, 1)).sources] == [3]


def test_a_kill_between_two_parts_is_gone_on_from(path: Path) -> None:
    killed = SplitWriter(path, Split(seconds=0.5), PARTS)
    write(killed, range(7))
    killed._wait()
    killed._part.flush()  # type: ignore[attr-defined]
    # As where the kill came while the first part was being finished.
    os.rename(part_path(path, 0), partial_path(part_path(path, 0)))
    assert parts_of(path) == {0: False, 1: False}
    again = SplitWriter(path, Split(seconds=0.5), PARTS, resume=True)
    again.take_over()
    write(again, range(9, 12))
    assert not again.close()
    assert parts_of(path) == {0: True, 1: True}
    assert [numbers_of(part_path(path, number)) for number in range(2)] == [[*range(5)], [5, 6, 9, 10, 11]]
    assert [info(part_path(path, number)).sources[0].missing for number in range(2)] == [0, 2]
    assert info(part_path(path, 1)).attachments == {"field": 3}


def test_parts_that_are_there_are_not_written_over(path: Path) -> None:
    SplitWriter(path, Split(seconds=1.0), PARTS).close()
    for resume in (False, True):
        with pytest.raises(RecordingError, match=r"run-000\.mcap: a part of another recording is there already"):
            SplitWriter(path, Split(seconds=1.0), PARTS, resume=resume)
    RecordingWriter(path).close()
    with pytest.raises(RecordingError, match=r"run\.mcap: is there already"):
        RecordingWriter(path)
