"""Reading recordings whole, damaged and forged."""

from __future__ import annotations

import functools
import operator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, IndexType, Writer
from support.bus_samples import ADDRESS, every_message, frame, guess, same, truth

from fieldpose.bus.codec import encode
from fieldpose.bus.mcap_files import Attachment, reader_of
from fieldpose.bus.messages import CameraOrigin, Header
from fieldpose.bus.reading import info, read_attachment, read_recording
from fieldpose.bus.recording import RecordingWriter
from fieldpose.bus.recovery import recover
from fieldpose.bus.topics import FRAME, GUESS, STATE, TRUTH
from fieldpose.errors import RecordingError

SECOND_NS = 10**9


def record(path: Path, frames: int = 6, period_ns: int = SECOND_NS // 10) -> Path:
    """Frames with their truth, and guesses that come in the file after frames that came later."""
    writer = RecordingWriter(path, {"config": {"a": "b"}}, [Attachment("note", "text/plain", b"hello")])
    for frame_id in range(frames):
        for topic, message in ((FRAME, frame(frame_id)), (TRUTH, truth(frame_id))):
            message.header = Header("camera", frame_id, frame_id, 0, 1000 + frame_id, 5)
            writer.write(ADDRESS.key(topic), topic, message, 7 * SECOND_NS + frame_id * period_ns)
    early = guess(9, pass_index=2)
    writer.write(ADDRESS.key(GUESS), GUESS, early, 6 * SECOND_NS)
    writer.close()
    return path


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("recordings") / "whole.mcap")


class TestReading:
    def test_messages_come_in_the_order_of_their_receipt(self, recording: Path) -> None:
        recorded = list(read_recording(recording))
        assert len(recorded) == 13
        assert recorded[0].topic is GUESS
        assert [each.log_time_ns for each in recorded] == sorted(each.log_time_ns for each in recorded)
        assert same(recorded[1].message.image, frame(0).image)  # type: ignore[attr-defined]

    def test_topics_are_chosen(self, recording: Path) -> None:
        assert [each.message.header.frame_id for each in read_recording(recording, {TRUTH})] == list(range(6))

    def test_info_tells_topics_rates_sources_and_what_else_is_in_it(self, recording: Path) -> None:
        facts = info(recording)
        topics = {each.topic: each for each in facts.topics}
        assert (topics["frame"].messages, topics["guess"].messages) == (6, 1)
        assert topics["frame"].rate_hz == pytest.approx(10.0)
        assert topics["frame"].first_ns == 7 * SECOND_NS
        assert topics["frame"].last_ns == 7 * SECOND_NS + SECOND_NS // 2
        assert (facts.first_ns, facts.messages, facts.lossless) == (6 * SECOND_NS, 13, True)
        assert {each.source for each in facts.sources} == {"camera", ""}
        assert facts.metadata["config"] == {"a": "b"}
        assert facts.attachments == {"note": 5}

    def test_info_reads_no_messages_of_a_file_that_has_an_index_of_them(self, recording: Path, tmp_path: Path) -> None:
        damaged = bytearray(recording.read_bytes())
        at = damaged.index(frame(3).image.tobytes())
        damaged[at] ^= 1
        path = tmp_path / "damaged.mcap"
        path.write_bytes(damaged)
        assert info(path) == replace(info(recording), path=str(path))
        with pytest.raises(RecordingError, match="not a whole recording"):
            list(read_recording(path))

    @settings(derandomize=True, deadline=None, max_examples=80)
    @given(
        st.lists(st.tuples(st.integers(0, 3), st.integers(0, 2**62), st.integers(0, 300)), max_size=40),
        st.sets(st.sampled_from([IndexType.ATTACHMENT, IndexType.CHUNK, IndexType.MESSAGE, IndexType.METADATA])),
        st.fixed_dictionaries({name: st.booleans() for name in ("use_chunking", "use_statistics", "enable_crcs")}),
        st.sampled_from(CompressionType),
    )
    def test_info_says_of_any_file_what_reading_it_says(
        self,
        tmp_path_factory: pytest.TempPathFactory,
        messages: list[tuple[int, int, int]],
        indexes: set[IndexType],
        options: dict[str, bool],
        compression: CompressionType,
    ) -> None:
        path = tmp_path_factory.mktemp("any") / "any.mcap"
        index_types = functools.reduce(operator.or_, indexes, IndexType.NONE)
        writer = Writer(str(path), chunk_size=500, compression=compression, index_types=index_types, **options)
        writer.start()
        # Two channels of one key.
        channels = [writer.register_channel(name, "x", 0) for name in ("a", "b", "a", ADDRESS.key(FRAME))]
        for channel, time_ns, size in messages:
            writer.add_message(channels[channel], time_ns, bytes(size), time_ns)
        writer.add_attachment(1, 1, "note", "text/plain", b"hello")
        writer.finish()
        times: dict[str, list[int]] = {}
        with reader_of(path) as reader:
            for _, channel, message in reader.iter_messages():
                times.setdefault(channel.topic, []).append(message.log_time)
        facts = info(path)
        everything = [time_ns for those in times.values() for time_ns in those]
        assert (facts.messages, facts.first_ns, facts.last_ns) == (
            len(everything), min(everything, default=0), max(everything, default=0),
        )  # fmt: skip
        said = {topic.key: (topic.messages, topic.first_ns, topic.last_ns, topic.rate_hz) for topic in facts.topics}
        assert said == {
            key: (
                len(those), min(those), max(those),
                (len(those) - 1) / ((max(those) - min(those)) / 1e9) if max(those) > min(those) else 0.0,
            ) for key, those in times.items()
        }  # fmt: skip

    def test_attachments_are_read_by_name(self, recording: Path) -> None:
        assert read_attachment(recording, "note") == b"hello"
        with pytest.raises(RecordingError, match="no attachment 'field'"):
            read_attachment(recording, "field")

    def test_an_older_recording_is_read_whose_messages_lack_what_came_later(self, tmp_path: Path) -> None:
        writer = RecordingWriter(tmp_path / "older.mcap")
        for topic in (FRAME, STATE):
            fields = msgpack.unpackb(encode(every_message()[topic]))
            older = {name: value for name, value in fields.items() if name not in ("reason", "camera_origin")}
            writer.write_payload(ADDRESS.key(topic), topic, msgpack.packb(older), 1)
        assert writer.close()
        older_frame, state = (each.message for each in read_recording(tmp_path / "older.mcap"))
        assert same(older_frame, frame(3))
        assert (state.reason, state.camera_origin) == (None, CameraOrigin.CALIBRATED)  # type: ignore[attr-defined]

    def test_a_forged_message_is_one_clear_line(self, tmp_path: Path) -> None:
        writer = RecordingWriter(tmp_path / "forged.mcap")
        writer._put(ADDRESS.key(GUESS), GUESS, b"rubbish", Header("x", 0, 0, 0, 0, 0), 1)
        writer.close()
        with pytest.raises(RecordingError, match="a message on test/track/mug/cam/guess cannot be read: Guess"):
            list(read_recording(tmp_path / "forged.mcap"))

    def test_what_is_no_recording_is_one_clear_line(self, tmp_path: Path) -> None:
        text = tmp_path / "text.mcap"
        text.write_text("this is a text, and no recording at all " * 10)
        for path in (text, tmp_path, tmp_path / "nowhere.mcap"):
            for read in (lambda p: list(read_recording(p)), info, lambda p: recover(p, tmp_path / "out.mcap")):
                with pytest.raises(RecordingError) as caught:
                    read(path)
                assert str(path) in str(caught.value)
                assert "\n" not in str(caught.value)
        assert {each.name for each in tmp_path.iterdir()} == {"text.mcap"}


class TestDamage:
    def test_a_cut_file_is_refused_and_recovered_up_to_the_cut(self, tmp_path: Path) -> None:
        whole = RecordingWriter(tmp_path / "whole.mcap", {"config": {"a": "b"}})
        for frame_id in range(40):
            whole.write(ADDRESS.key(FRAME), FRAME, frame(frame_id, width=480, height=360), frame_id)
        whole.close()
        data = (tmp_path / "whole.mcap").read_bytes()
        cut = tmp_path / "cut.mcap"
        cut.write_bytes(data[: len(data) * 3 // 4])
        with pytest.raises(RecordingError, match="not a whole recording"):
            list(read_recording(cut))
        saved = recover(cut, tmp_path / "saved.mcap")
        assert 24 <= saved <= 30
        ids = [each.message.header.frame_id for each in read_recording(tmp_path / "saved.mcap")]
        assert ids == list(range(saved))
        facts = info(tmp_path / "saved.mcap")
        assert not facts.lossless
        assert facts.metadata["config"] == {"a": "b"}

    @settings(derandomize=True, deadline=None, max_examples=25)
    @given(st.integers(1, 99))
    def test_whole_messages_of_the_chunk_that_is_cut_are_saved(
        self, tmp_path_factory: pytest.TempPathFactory, share: int
    ) -> None:
        """All 25 messages are in one chunk, which the reader alone would give as a whole or not at all."""
        folder = tmp_path_factory.mktemp("cut")
        whole = RecordingWriter(folder / "whole.mcap")
        for frame_id in range(25):
            whole.write(ADDRESS.key(FRAME), FRAME, frame(frame_id, width=80, height=60), frame_id)
        whole.close()
        data = (folder / "whole.mcap").read_bytes()
        size = 80 * 60 * 3
        cut = folder / "cut.mcap"
        cut.write_bytes(data[: len(data) * share // 100])
        most = len(data) * share // 100 // size
        if most < 2:
            with suppress(RecordingError):
                recover(cut, folder / "saved.mcap")
            return
        saved = recover(cut, folder / "saved.mcap")
        assert most - 2 <= saved <= min(most, 25)
        ids = [each.message.header.frame_id for each in read_recording(folder / "saved.mcap")]
        assert ids == list(range(saved))

    def test_where_nothing_is_whole_nothing_is_written(self, recording: Path, tmp_path: Path) -> None:
        cut = tmp_path / "cut.mcap"
        cut.write_bytes(recording.read_bytes()[:120])
        with pytest.raises(RecordingError, match="no whole message is in it"):
            recover(cut, tmp_path / "saved.mcap")
        assert {path.name for path in tmp_path.iterdir() if "saved" in path.name} == set()

    def test_recovering_a_whole_file_loses_nothing(self, recording: Path, tmp_path: Path) -> None:
        assert recover(recording, tmp_path / "copy.mcap") == 13
        facts, copy = info(recording), info(tmp_path / "copy.mcap")
        assert copy.lossless
        assert (copy.topics, copy.sources, copy.metadata) == (facts.topics, facts.sources, facts.metadata)
        assert read_attachment(tmp_path / "copy.mcap", "note") == b"hello"

    @settings(derandomize=True, deadline=None, max_examples=60)
    @given(st.data())
    def test_any_damage_raises_recording_errors_only(self, recording: Path, data: st.DataObject) -> None:
        damaged = bytearray(recording.read_bytes())
        for _ in range(data.draw(st.integers(1, 6))):
            damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
        del damaged[data.draw(st.integers(0, len(damaged))) :]
        path, saved = recording.with_name("damaged.mcap"), recording.with_name("saved.mcap")
        path.write_bytes(damaged)
        for read in (lambda p: list(read_recording(p)), info, lambda p: recover(p, saved)):
            with suppress(RecordingError):
                read(path)
