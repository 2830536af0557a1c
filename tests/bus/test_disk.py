"""Disks that fill up, folders that go away, files that are in the way: a readable recording and one clear line."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from support.bus_samples import ADDRESS, frame

from fieldpose.bus.codec import encode
from fieldpose.bus.messages import Header
from fieldpose.bus.open_recording import partial_path
from fieldpose.bus.ports import Outbox
from fieldpose.bus.reading import info, read_recording
from fieldpose.bus.recorder import Recorder
from fieldpose.bus.recording import RecordingWriter
from fieldpose.bus.topics import FRAME, Address
from fieldpose.bus.transport import MemoryBus
from fieldpose.errors import RecordingError

Spawn = Callable[..., "subprocess.Popen[str]"]
KEY = ADDRESS.key(FRAME)
EVERYTHING = Address("*", "*", "*")
FULL_MB, MESSAGES = 24, 60

FILL = """
    import resource, sys
    from fieldpose.bus.codec import encode
    from fieldpose.bus.messages import Header
    from fieldpose.bus.recording import RecordingWriter
    from fieldpose.bus.topics import FRAME
    from fieldpose.errors import RecordingError
    from support.bus_samples import ADDRESS, frame

    if len(sys.argv) > 3:
        resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[3]) << 20, int(sys.argv[3]) << 20))
    image = frame(0, width=640, height=480)
    try:
        writer = RecordingWriter(sys.argv[1])
        for number in range(int(sys.argv[2])):
            image.header = Header("camera", number, number, 0, number, number)
            writer.write(ADDRESS.key(FRAME), FRAME, image, number)
    except RecordingError as error:
        print(error)
    except OSError as error:
        print(writer.end_early(error))
    else:
        print("there was room")
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "out" / "run.mcap"


def write(writer: RecordingWriter, numbers: range) -> None:
    for number in numbers:
        message = frame(number, 100, 75, Header("camera", number, number, 0, number, number))
        writer.write_payload(KEY, FRAME, encode(message), number)


def frame_ids(path: Path) -> list[int]:
    return [each.message.header.frame_id for each in read_recording(path)]


def check_ended(path: Path, said: str, why: str) -> None:
    assert said == f"{path}: the recording ended early: {why}; what came before is in it"
    facts = info(path)
    assert facts.ended == why
    assert not facts.lossless
    assert 3 < facts.messages < MESSAGES
    assert frame_ids(path) == list(range(facts.messages))
    assert not partial_path(path).exists()


def test_a_limit_of_the_size_of_files_leaves_a_whole_recording(tmp_path: Path, spawn: Spawn) -> None:
    path = tmp_path / "run.mcap"
    said, errors = spawn(FILL, str(path), str(MESSAGES), str(FULL_MB)).communicate(timeout=60)
    assert errors == ""
    check_ended(path, said.strip(), "File too large")


def on_a_small_disk(folder: Path, options: str) -> tuple[str, list[str]]:
    """What FILL says of a file system with these options, mounted at `folder` in a namespace, and what it leaves there.

    Files are copied to a folder beside it, named "copy".
    """
    program, disk = folder / "fill.py", folder / "disk"
    program.write_text(textwrap.dedent(FILL))
    disk.mkdir()
    script = (
        f"mount -t tmpfs -o {options} none {disk} || exit 77\n"
        f"{sys.executable} {program} {disk}/run.mcap {MESSAGES} || exit 1\n"
        f"ls -A {disk} >&2 && cp -r {disk} {folder}/copy"
    )
    root = Path(__file__).parents[2]
    environment = {**os.environ, "PYTHONPATH": f"{root}:{root / 'tests'}"}
    command = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c", script]
    try:
        ended = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60, check=False)
    except FileNotFoundError:
        pytest.skip("no unshare here")
    if ended.returncode == 77 or "unshare" in ended.stderr:
        pytest.skip("no namespaces here")
    assert ended.returncode == 0, ended.stderr
    return ended.stdout.strip(), ended.stderr.split()


def test_a_full_disk_leaves_a_whole_recording(tmp_path: Path) -> None:
    said, left = on_a_small_disk(tmp_path, f"size={FULL_MB}m")
    assert left == ["run.mcap"]
    path = tmp_path / "copy" / "run.mcap"
    check_ended(path, said.replace(str(tmp_path / "disk"), str(path.parent)), "No space left on device")
    assert path.stat().st_size > (FULL_MB - 17) << 20


@pytest.mark.parametrize(("options", "why"), [("ro", "Read-only file system"), ("size=1m", "No space left on device")])
def test_a_disk_on_which_nothing_can_be_begun_is_one_clear_line(tmp_path: Path, options: str, why: str) -> None:
    said, left = on_a_small_disk(tmp_path, options)
    assert said == f"{tmp_path / 'disk' / 'run.mcap.partial'}: cannot be written: {why}"
    assert left == []


def test_a_folder_that_is_removed_comes_back_with_what_came_before(path: Path) -> None:
    bus = MemoryBus()
    recorder = Recorder(bus, EVERYTHING, lambda: RecordingWriter(path))
    outbox = Outbox(bus, ADDRESS, "camera")
    for number in range(5):
        outbox.publish(FRAME, frame(number, 100, 75))
    shutil.rmtree(path.parent)
    while recorder.error is None:
        outbox.publish(FRAME, frame(5, 100, 75))
        time.sleep(0.01)
    with pytest.raises(RecordingError) as told:
        recorder.close()
    assert str(told.value) == (
        f"{path}: the recording ended early: it was removed or moved while it was being written; what came before is"
        " in it"
    )
    assert info(path).ended is not None
    assert frame_ids(path)[:5] == list(range(5))
    assert list(path.parent.iterdir()) == [path]


def test_a_folder_that_is_removed_just_before_the_end_loses_nothing(path: Path) -> None:
    writer = RecordingWriter(path)
    write(writer, range(5))
    shutil.rmtree(path.parent)
    assert writer.close()
    assert frame_ids(path) == list(range(5))


def test_a_file_that_has_come_in_the_meantime_is_not_replaced(path: Path) -> None:
    writer = RecordingWriter(path)
    write(writer, range(3))
    path.write_text("somebody else's")
    with pytest.raises(RecordingError, match=r"another file has come there; it is whole, as .*run\.mcap\.partial"):
        writer.close()
    assert path.read_text() == "somebody else's"
    assert frame_ids(partial_path(path)) == [0, 1, 2]


def test_a_finished_recording_is_never_begun_again(path: Path) -> None:
    RecordingWriter(path).close()
    before = path.read_bytes()
    for resume in (False, True):
        with pytest.raises(RecordingError, match="is there already, and no recording replaces a file"):
            RecordingWriter(path, resume=resume)
    assert path.read_bytes() == before
