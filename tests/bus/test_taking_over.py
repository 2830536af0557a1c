"""What a killed recorder left is gone on with, however long copying takes, and never lost by it."""

from __future__ import annotations

import subprocess
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from support.bus_samples import ADDRESS, frame

from fieldpose.bus.codec import encode
from fieldpose.bus.messages import Header
from fieldpose.bus.open_recording import aside_path, partial_path, unfinished_file
from fieldpose.bus.ports import Outbox
from fieldpose.bus.reading import info, read_recording
from fieldpose.bus.recorder import RecorderHandler
from fieldpose.bus.recording import RecordingWriter
from fieldpose.bus.splitting import Split, SplitWriter, native_parts, part_path
from fieldpose.bus.tee import Tee
from fieldpose.bus.topics import FRAME, Address
from fieldpose.bus.transport import MemoryBus
from fieldpose.deploy.cli import main
from fieldpose.errors import RecordingError

Spawn = Callable[..., "subprocess.Popen[str]"]
KEY = ADDRESS.key(FRAME)
ENOUGH_S = 30.0
FRAMES = 40

GO_ON = """
    import resource, sys, time
    from fieldpose.bus.recorder import Recorder
    from fieldpose.bus.recording import RecordingWriter
    from fieldpose.bus.topics import Address
    from fieldpose.bus.transport import MemoryBus
    from fieldpose.errors import RecordingError

    class Slow(RecordingWriter):
        def write_payload(self, *message):
            super().write_payload(*message)
            if self.messages == 5:
                self.flush()
                print("five", flush=True)
                time.sleep(60)

    if len(sys.argv) > 2:
        resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]) << 20, int(sys.argv[2]) << 20))
    kind = RecordingWriter if len(sys.argv) > 2 else Slow
    recorder = Recorder(MemoryBus(), Address("*", "*", "*"), lambda: kind(sys.argv[1], resume=True))
    try:
        recorder.close()
    except RecordingError as error:
        print(error)
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run.mcap"


def write(writer: RecordingWriter, numbers: range) -> None:
    for number in numbers:
        message = frame(number, 320, 240, Header("camera", number, number, 0, number, number))
        writer.write_payload(KEY, FRAME, encode(message), number)


def leave_unfinished(path: Path) -> bytes:
    writer = RecordingWriter(path)
    write(writer, range(FRAMES))
    writer.flush()
    return partial_path(path).read_bytes()


def frame_ids(path: Path) -> list[int]:
    return [each.message.header.frame_id for each in read_recording(path)]


class Held(RecordingWriter):
    """Copies only once it may."""

    may = threading.Event()

    def take_over(self) -> None:
        assert self.may.wait(ENOUGH_S)
        super().take_over()


def test_a_recorder_listens_and_beats_while_it_copies_and_loses_nothing(path: Path) -> None:
    leave_unfinished(path)
    bus = MemoryBus()
    handler = RecorderHandler(bus, Address("test", "*", "*"), lambda: Held(path, resume=True))
    outbox = Outbox(bus, ADDRESS, "camera")
    for number in range(3):
        outbox.publish(FRAME, frame(FRAMES + number))
        assert list(handler.tick(0)) == []
    Held.may.set()
    handler.stop()
    assert frame_ids(path) == list(range(FRAMES + 3))
    assert list(path.parent.iterdir()) == [path]


def test_a_recorder_that_is_killed_while_it_copies_has_lost_nothing(
    path: Path, spawn: Spawn, capsys: pytest.CaptureFixture[str]
) -> None:
    before = leave_unfinished(path)
    copying = spawn(GO_ON, str(path))
    assert copying.stdout is not None
    assert copying.stdout.readline() == "five\n"
    copying.kill()
    copying.wait()
    assert 0 < partial_path(path).stat().st_size < len(before)
    assert aside_path(path).read_bytes() == before
    with pytest.raises(RecordingError, match=r"run\.mcap\.partial\.before: an unfinished recording is in the way"):
        RecordingWriter(path)
    for name in ("run.mcap", "run.mcap.partial", "run.mcap.partial.before"):
        assert main(["recover", str(path.with_name(name))]) == 0
        saved = path.with_name("run.recovered.mcap")
        assert capsys.readouterr().out == f"{saved}: {FRAMES} messages saved of {aside_path(path)}\n"
        assert frame_ids(saved) == list(range(FRAMES))
        saved.unlink()
    again = RecordingWriter(path, resume=True)
    again.take_over()
    write(again, range(FRAMES, FRAMES + 2))
    assert again.close()
    assert frame_ids(path) == list(range(FRAMES + 2))
    assert list(path.parent.iterdir()) == [path]


def test_one_that_has_no_room_to_copy_leaves_what_was_there_and_says_so(path: Path, spawn: Spawn) -> None:
    before = leave_unfinished(path)
    assert len(before) > 8 << 20
    # 16 MiB are kept for the end of a file.
    said, errors = spawn(GO_ON, str(path), "20").communicate(timeout=60)
    assert errors == ""
    assert said.strip() == (
        f"{partial_path(path)}: the recorder cannot go on with it: File too large; `fieldpose recover` saves what is in"
        " it"
    )
    assert list(path.parent.iterdir()) == [partial_path(path)]
    assert partial_path(path).read_bytes() == before


def test_what_is_no_recording_is_left_as_it_is(path: Path) -> None:
    partial_path(path).write_text("somebody's, and no recording")
    writer = RecordingWriter(path, resume=True)
    with pytest.raises(RecordingError, match=r"run\.mcap\.partial: the recorder cannot go on with it: is no recording"):
        writer.take_over()
    assert unfinished_file(path) == partial_path(path)
    assert partial_path(path).read_text() == "somebody's, and no recording"


def test_of_parts_the_last_is_finished_where_an_earlier_one_cannot_be(path: Path) -> None:
    partial_path(part_path(path, 0)).write_text("somebody's, and no recording")
    leave_unfinished(part_path(path, 1))
    writer = SplitWriter(path, Split(seconds=1.0), native_parts(), resume=True)
    with pytest.raises(OSError, match="is no recording") as caught:
        writer.take_over()
    said = str(writer.end_early(caught.value))
    assert said.startswith(f"{part_path(path, 1)}: the recording ended early: {partial_path(part_path(path, 0))}: ")
    assert frame_ids(part_path(path, 1)) == list(range(FRAMES))
    assert partial_path(part_path(path, 0)).read_text() == "somebody's, and no recording"


def test_of_two_forms_one_is_finished_where_the_other_cannot_be_gone_on_with(path: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.mcap"
    leave_unfinished(path)
    partial_path(other).write_text("somebody's, and no recording")
    tee = Tee([RecordingWriter(path, resume=True), RecordingWriter(other, resume=True)])
    with pytest.raises(RecordingError, match=r"other\.mcap\.partial: .*; .*run\.mcap: the recording ended early"):
        tee.take_over()
    assert info(path).messages == FRAMES
    assert set(tmp_path.iterdir()) == {path, partial_path(other)}
