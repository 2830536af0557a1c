"""What came last is kept within its bounds, and saved as a whole recording when tracking is lost or it is asked for."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

import msgspec
import pytest
from support.bus_samples import ADDRESS, every_message, frame

from fieldpose.bus.codec import encode
from fieldpose.bus.control import ask_one
from fieldpose.bus.mcap_files import SNAPSHOT_RECORD, Attachment
from fieldpose.bus.messages import Header, TrackingState
from fieldpose.bus.ports import Outbox
from fieldpose.bus.reading import info, read_recording
from fieldpose.bus.recorder import Recorder
from fieldpose.bus.recording import RecordingWriter
from fieldpose.bus.requests import SaveSnapshot, Show
from fieldpose.bus.ring import Ring, SnapshotConfig, Snapshots
from fieldpose.bus.topics import FRAME, STATE, Address
from fieldpose.bus.transport import Bus
from fieldpose.errors import RefusedError

Sessions = tuple[Bus, Bus]
KEY = ADDRESS.key(FRAME)
EVERYTHING = Address("test", "*", "*")
SECOND = 1_000_000_000
ENOUGH_S = 20.0


def payload(number: int) -> bytes:
    return encode(frame(number, header=Header("camera", number, number, 0, number, number)))


def state(which: TrackingState) -> Any:
    return msgspec.structs.replace(every_message()[STATE], state=which)


class TestRing:
    def test_what_is_older_is_let_go(self) -> None:
        ring = Ring(3.0, 1 << 30)
        for number in range(10):
            ring.add(KEY, FRAME, payload(number), number * SECOND)
        assert [item.received_ns // SECOND for item in ring.last(60.0)] == [6, 7, 8, 9]
        assert [item.received_ns // SECOND for item in ring.last(1.5)] == [8, 9]

    def test_no_more_bytes_are_held_than_allowed(self) -> None:
        ring = Ring(60.0, 250)
        for number in range(10):
            ring.add(KEY, FRAME, bytes([number]) * 100, number)
        assert [item.payload[0] for item in ring.last(60.0)] == [8, 9]
        ring.add(KEY, FRAME, bytes(251), 11)
        assert ring.last(60.0) == []


@pytest.fixture
def snapshots(tmp_path: Path) -> Snapshots:
    attached = [Attachment("settings.json", "application/json", b"{}")]
    return Snapshots(SnapshotConfig(tmp_path / "lost", most_lost=2), {"fieldpose.run": {"source": "x"}}, attached)


class TestSaving:
    def test_a_loss_is_saved_once_with_what_came_before(self, snapshots: Snapshots) -> None:
        outbox_states = [TrackingState.INITIALIZING, TrackingState.LOST, TrackingState.LOST, TrackingState.TRACKING]
        for number, which in enumerate(outbox_states):
            snapshots.add(KEY, FRAME, payload(number), number * SECOND)
            snapshots.add(ADDRESS.key(STATE), STATE, encode(state(which)), number * SECOND + 1)
        snapshots.close()
        (path,) = snapshots.saved
        assert path.name.startswith("lost-")
        facts = info(path)
        assert [each.message.header.frame_id for each in read_recording(path, (FRAME,))] == [0, 1]
        assert facts.metadata["fieldpose.run"] == {"source": "x"}
        assert facts.attachments == {"settings.json": 2}
        assert facts.metadata[SNAPSHOT_RECORD]["why"] == "lost"
        assert facts.metadata[SNAPSHOT_RECORD]["seconds"] == "1.000"

    def test_losses_of_each_pipeline_are_saved_up_to_a_number(self, snapshots: Snapshots) -> None:
        keys = [dataclasses.replace(ADDRESS, object=name).key(STATE) for name in ("lamp", "can")]
        for which in (TrackingState.TRACKING, TrackingState.LOST, TrackingState.LIMITED, TrackingState.LOST):
            for key in keys:
                snapshots.add(key, STATE, encode(state(which)), SECOND)
        snapshots.close()
        assert len(set(snapshots.saved)) == 2

    def test_no_loss_is_saved_where_that_is_not_wanted(self, tmp_path: Path) -> None:
        snapshots = Snapshots(SnapshotConfig(tmp_path, when_lost=False))
        for which in (TrackingState.TRACKING, TrackingState.LOST):
            snapshots.add(ADDRESS.key(STATE), STATE, encode(state(which)), SECOND)
        assert snapshots.save(5.0).messages == 2
        snapshots.close()
        assert [path.name.partition("-")[0] for path in tmp_path.iterdir()] == ["asked"]

    def test_a_loss_that_cannot_be_saved_is_survived(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        (tmp_path / "file").write_text("")
        snapshots = Snapshots(SnapshotConfig(tmp_path / "file"))
        for which in (TrackingState.TRACKING, TrackingState.LOST):
            snapshots.add(ADDRESS.key(STATE), STATE, encode(state(which)), SECOND)
        snapshots.close()
        assert snapshots.saved == []
        assert "could not be saved" in capsys.readouterr().err


class TestAsked:
    def test_the_recorder_of_all_pipelines_answers_whoever_asks(self, sessions: Sessions, tmp_path: Path) -> None:
        asker, bus = sessions
        recorder = Recorder(
            bus,
            EVERYTHING,
            lambda: RecordingWriter(tmp_path / "run.mcap"),
            Snapshots(SnapshotConfig(tmp_path / "kept")),
        )
        bus.settle(ENOUGH_S)
        asker.settle(ENOUGH_S)
        with pytest.raises(RefusedError, match="nothing has come yet that could be saved"):
            ask_one(asker, ADDRESS, "recorder", SaveSnapshot(seconds=10.0), ENOUGH_S)
        outbox = Outbox(asker, ADDRESS, "camera")
        for number in range(5):
            outbox.publish(FRAME, frame(number))
        deadline = time.monotonic() + ENOUGH_S
        while recorder.messages < 5 and time.monotonic() < deadline:
            time.sleep(0.01)
        names = set()
        for address in (ADDRESS, dataclasses.replace(ADDRESS, camera="other"), EVERYTHING):
            saved = ask_one(asker, address, "recorder", SaveSnapshot(seconds=10.0), ENOUGH_S)
            names.add(saved.path)
            assert saved.messages == info(saved.path).messages == 5
            assert 0 <= saved.seconds < ENOUGH_S
        assert {Path(name) for name in names} == set((tmp_path / "kept").iterdir())
        assert len(names) == 3
        with pytest.raises(RefusedError, match="show: the recorder takes no such request"):
            ask_one(asker, ADDRESS, "recorder", Show(), ENOUGH_S)
        assert recorder.close()
        assert info(tmp_path / "run.mcap").messages == 5

    def test_one_that_keeps_nothing_says_so(self, sessions: Sessions, tmp_path: Path) -> None:
        asker, bus = sessions
        recorder = Recorder(bus, EVERYTHING, lambda: RecordingWriter(tmp_path / "run.mcap"))
        with pytest.raises(RefusedError, match="keeps nothing in memory to be saved; start it with a folder"):
            ask_one(asker, ADDRESS, "recorder", SaveSnapshot(seconds=10.0), ENOUGH_S)
        recorder.close()
