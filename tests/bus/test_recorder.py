"""Recordings hold everything that was sent, say what they lack, and survive the death of who writes them."""

from __future__ import annotations

import json
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from support.bus_samples import ADDRESS, every_message, failure, frame, guess, same, truth

from fieldpose.bus.codec import encode
from fieldpose.bus.mcap_files import Attachment
from fieldpose.bus.messages import Header
from fieldpose.bus.open_recording import partial_path
from fieldpose.bus.ports import Inbox, Outbox
from fieldpose.bus.reading import info, read_recording
from fieldpose.bus.recorder import RECORDED, Recorder, RecorderHandler
from fieldpose.bus.recording import RecordingWriter
from fieldpose.bus.recovery import recover
from fieldpose.bus.topics import ALL, FAILURE, FRAME, GUESS, STATE, STATS, TRUTH, Address
from fieldpose.bus.transport import Bus, MemoryBus, ZenohBus, wait_for
from fieldpose.errors import RecordingError

Connect = Callable[[str], ZenohBus]
Spawn = Callable[..., "subprocess.Popen[str]"]

EVERYTHING = Address("*", "*", "*")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run.mcap"


class TestLive:
    def test_every_topic_of_the_table_is_recorded(self, path: Path) -> None:
        bus = MemoryBus()
        recorder = Recorder(bus, EVERYTHING, lambda: RecordingWriter(path))
        outbox = Outbox(bus, ADDRESS, "pnp")
        before_ns = time.time_ns()
        for topic, message in every_message().items():
            outbox.publish(topic, message)
        assert recorder.close()
        recorded = list(read_recording(path))
        assert {each.topic for each in recorded} == set(ALL) == set(RECORDED)
        for each in recorded:
            sent = every_message()[each.topic]
            sent.header = each.message.header
            assert same(each.message, sent)
            assert each.key == ADDRESS.key(each.topic, "pnp")
            assert before_ns <= each.message.header.sent_ns <= each.log_time_ns <= time.time_ns()

    def test_gaps_make_a_recording_not_lossless(self, path: Path) -> None:
        bus = MemoryBus()
        recorder = Recorder(bus, EVERYTHING, lambda: RecordingWriter(path, from_start=True))
        for sequence in (2, 3, 7):
            message = guess(sequence)
            message.header = Header("tracking", sequence, sequence, 0, 0, 0)
            bus.put(ADDRESS.key(GUESS), encode(message), GUESS)
        assert not recorder.close()
        (source,) = info(path).sources
        assert (source.received, source.written, source.missing) == (3, 3, 2 + 3)
        assert not info(path).lossless

    def test_the_failures_of_several_stages_are_counted_by_stage(self, path: Path) -> None:
        bus = MemoryBus()
        recorder = Recorder(bus, EVERYTHING, lambda: RecordingWriter(path, from_start=True))
        outboxes = {stage: Outbox(bus, ADDRESS, stage) for stage in ("lifting", "matching", "pnp")}
        for frame_id, stage in enumerate(("pnp", "matching", "pnp", "lifting", "pnp", "matching")):
            outboxes[stage].publish(FAILURE, failure(frame_id, stage))
        assert recorder.close()
        assert [(each.source, each.received, each.written, each.missing) for each in info(path).sources] == [
            ("lifting", 1, 1, 0),
            ("matching", 2, 2, 0),
            ("pnp", 3, 3, 0),
        ]
        assert info(path).lossless

    def test_a_full_queue_drops_counts_and_says_so(self, path: Path) -> None:
        bus = MemoryBus()
        size = len(encode(frame(0)))
        recorder = Recorder(bus, EVERYTHING, lambda: RecordingWriter(path), queue_bytes=size - 1)
        outbox = Outbox(bus, ADDRESS, "camera")
        for frame_id in range(5):
            outbox.publish(FRAME, frame(frame_id))
            outbox.publish(TRUTH, truth(frame_id))
            deadline = time.monotonic() + 30
            while recorder.messages <= frame_id and time.monotonic() < deadline:
                time.sleep(0.001)
        assert not recorder.close()
        counts = {each.key.rsplit("/", 1)[-1]: each for each in info(path).sources}
        assert (counts["frame"].received, counts["frame"].written, counts["frame"].missing) == (5, 0, 0)
        assert (counts["truth"].received, counts["truth"].written) == (5, 5)

    def test_rubbish_is_refused_and_counted(self, path: Path) -> None:
        bus = MemoryBus()
        recorder = Recorder(bus, EVERYTHING, lambda: RecordingWriter(path))
        bus.put(ADDRESS.key(GUESS), b"rubbish", GUESS)
        Outbox(bus, ADDRESS, "tracking").publish(GUESS, guess())
        assert not recorder.close()
        assert info(path).metadata["fieldpose.recording"]["refused"] == "1"
        assert len(list(read_recording(path))) == 1


class TestFile:
    def test_any_mcap_reader_understands_it(self, path: Path) -> None:
        writer = RecordingWriter(path)
        message = frame(3)
        message.header = Header("camera", 17, 3, 0, 100, 200)
        writer.write(ADDRESS.key(FRAME), FRAME, message, 300)
        writer.close()
        with open(path, "rb") as stream:
            ((schema, channel, raw),) = make_reader(stream, validate_crcs=True).iter_messages()
        assert (channel.topic, channel.message_encoding) == ("test/camera/cam/frame", "msgpack")
        assert (raw.log_time, raw.publish_time, raw.sequence) == (300, 200, 17)
        assert schema is not None
        assert (schema.name, schema.encoding) == ("Frame", "jsonschema")
        properties = json.loads(schema.data)["$defs"]["Frame"]["properties"]
        assert set(properties) == {"header", "image", "encoding", "camera", "camera_origin"}

    def test_the_schema_says_which_fields_may_be_missing(self, path: Path) -> None:
        writer = RecordingWriter(path)
        writer.write(ADDRESS.key(STATE), STATE, every_message()[STATE], 300)
        writer.close()
        with open(path, "rb") as stream:
            ((schema, _, _),) = make_reader(stream).iter_messages()
        assert schema is not None
        state = json.loads(schema.data)["$defs"]["State"]
        assert set(state["properties"]) - set(state["required"]) == {"reason", "camera_origin", "level"}

    def test_chunks_are_uncompressed_and_of_a_few_megabytes(self, path: Path) -> None:
        writer = RecordingWriter(path)
        for frame_id in range(20):
            writer.write(ADDRESS.key(FRAME), FRAME, frame(frame_id, width=480, height=360), frame_id)
        writer.close()
        with open(path, "rb") as stream:
            summary = make_reader(stream).get_summary()
        assert summary is not None
        assert {chunk.compression for chunk in summary.chunk_indexes} == {""}
        assert all(1 << 20 < chunk.uncompressed_size < 4 << 20 for chunk in summary.chunk_indexes[:-1])
        assert len(summary.chunk_indexes) >= 3

    def test_metadata_and_attachments_are_in_it_from_the_start_on(self, path: Path) -> None:
        writer = RecordingWriter(path, {"config": {"depth": "2"}}, [Attachment("field.txt", "text/plain", b"abc")])
        assert b"depth" in partial_path(path).read_bytes()
        assert b"field.txt" in partial_path(path).read_bytes()
        assert not path.exists()
        writer.add({"seeds": {"numpy": "7"}})
        writer.close()
        facts = info(path)
        assert (facts.metadata["config"], facts.metadata["seeds"]) == ({"depth": "2"}, {"numpy": "7"})
        assert facts.attachments == {"field.txt": 3}
        assert not partial_path(path).exists()

    def test_an_unfinished_recording_is_not_written_over(self, path: Path) -> None:
        unfinished = RecordingWriter(path)
        with pytest.raises(RecordingError, match="unfinished recording is in the way"):
            RecordingWriter(path)
        unfinished.discard()
        RecordingWriter(path).close()
        assert info(path).messages == 0

    def test_a_folder_that_cannot_be_made_is_one_clear_line(self, tmp_path: Path) -> None:
        (tmp_path / "file").write_text("")
        with pytest.raises(RecordingError, match="cannot be written"):
            RecordingWriter(tmp_path / "file" / "run.mcap")


RECORD = """
    import sys
    from fieldpose.bus.node import run_node
    from fieldpose.bus.recorder import RecorderHandler
    from fieldpose.bus.recording import RecordingWriter
    from fieldpose.bus.topics import Address
    from fieldpose.bus.transport import ZenohBus
    from support.bus_samples import ADDRESS

    bus = ZenohBus(sys.argv[1])
    options = {"metadata": {"run": {"id": "7"}}, "resume": True, "from_start": True}
    store = lambda: RecordingWriter(sys.argv[2], **options)
    run_node(RecorderHandler(bus, Address("test", "*", "*"), store), bus, ADDRESS)
    bus.close()
"""


class TestProcess:
    def test_nothing_of_500_images_is_lost(self, hub: str, path: Path, connect: Connect, spawn: Spawn) -> None:
        process = spawn(RECORD, hub, str(path))
        sender = connect(hub)
        wait_for(sender, ADDRESS, ["recorder"], 10.0)
        outbox = Outbox(sender, ADDRESS, "camera")
        image = frame(0, width=480, height=360)
        for frame_id in range(500):
            image.header = Header("", 0, frame_id, 0, frame_id, 0)
            outbox.publish(FRAME, image)
            outbox.publish(TRUTH, truth(frame_id))
            time.sleep(0.005)
        time.sleep(0.5)
        process.send_signal(signal.SIGTERM)
        assert process.wait(20.0) == 0
        facts = info(path)
        counts = {(each.key, each.source): (each.received, each.written, each.missing) for each in facts.sources}
        assert counts[ADDRESS.key(FRAME), "camera"] == (500, 500, 0)
        assert counts[ADDRESS.key(TRUTH), "camera"] == (500, 500, 0)
        assert facts.lossless
        assert facts.size_bytes > 500 * image.image.nbytes

    def publish(self, outbox: Outbox, ids: range) -> None:
        for frame_id in ids:
            outbox.publish(FRAME, frame(frame_id, width=240, height=180))
            time.sleep(0.005)

    def test_a_killed_recorder_leaves_what_recover_saves(
        self, hub: str, path: Path, tmp_path: Path, connect: Connect, spawn: Spawn
    ) -> None:
        bus = connect(hub)
        process = spawn(RECORD, hub, str(path))
        wait_for(bus, ADDRESS, ["recorder"], 10.0)
        outbox = Outbox(bus, ADDRESS, "camera")
        self.publish(outbox, range(60))
        time.sleep(1.2)
        process.kill()
        process.wait()
        assert not path.exists()
        with pytest.raises(RecordingError, match="`fieldpose recover` saves what is in it"):
            info(partial_path(path))
        saved = recover(partial_path(path), tmp_path / "saved.mcap")
        facts = info(tmp_path / "saved.mcap")
        frames = [each for each in read_recording(tmp_path / "saved.mcap") if each.topic is FRAME]
        assert saved == facts.messages >= 60
        assert [each.message.header.frame_id for each in frames] == list(range(60))
        assert np.array_equal(frames[-1].message.image, frame(59, width=240, height=180).image)  # type: ignore
        assert not facts.lossless
        assert facts.metadata["run"] == {"id": "7"}

    def test_a_recorder_that_is_started_again_goes_on_and_knows_what_it_missed(
        self, hub: str, path: Path, connect: Connect, spawn: Spawn
    ) -> None:
        bus = connect(hub)
        outbox = Outbox(bus, ADDRESS, "camera")
        first = spawn(RECORD, hub, str(path))
        wait_for(bus, ADDRESS, ["recorder"], 10.0)
        self.publish(outbox, range(20))
        time.sleep(1.2)
        first.kill()
        first.wait()
        self.publish(outbox, range(20, 25))
        second = spawn(RECORD, hub, str(path))
        wait_for(bus, ADDRESS, ["recorder"], 10.0)
        self.publish(outbox, range(25, 40))
        time.sleep(0.2)
        second.send_signal(signal.SIGTERM)
        assert second.wait(5.0) == 0
        facts = info(path)
        (camera,) = [each for each in facts.sources if each.source == "camera"]
        assert (camera.received, camera.written, camera.missing) == (35, 35, 5)
        assert not facts.lossless
        assert list(path.parent.iterdir()) == [path]

    def test_the_handler_listens_once_it_is_ready_and_finishes_when_stopped(self, path: Path) -> None:
        bus: Bus = MemoryBus()
        handler = RecorderHandler(bus, Address("test", "*", "*"), lambda: RecordingWriter(path))
        handler.start()
        Outbox(bus, ADDRESS, "tracking").publish(GUESS, guess())
        assert list(handler.tick(0)) == []
        handler.stop()
        assert info(path).messages == 1

    def test_stats_are_recorded_too(self, path: Path) -> None:
        bus = MemoryBus()
        inbox = Inbox(bus, ADDRESS, [STATS])
        recorder = Recorder(bus, EVERYTHING, lambda: RecordingWriter(path), topics=[STATS])
        Outbox(bus, ADDRESS, "pnp").publish(STATS, every_message()[STATS])
        recorder.close()
        assert len(inbox.drain()) == info(path).messages == 1
