"""What a run does about its recorder: refuses what is in the way, passes on how to record, tells what went wrong."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import msgspec
import pytest
from support.bus_samples import ADDRESS, every_message, guess, truth
from support.commands import save_empty_field

from fieldpose.bus.memory import MemoryBus
from fieldpose.bus.messages import Header, TrackingState
from fieldpose.bus.open_recording import aside_path, partial_path
from fieldpose.bus.ports import Outbox
from fieldpose.bus.reading import info
from fieldpose.bus.recorder import Recorder, RecorderHandler, Store
from fieldpose.bus.recording import RecordingWriter
from fieldpose.bus.ring import SnapshotConfig, Snapshots
from fieldpose.bus.topics import GUESS, STATE, TRUTH, Address
from fieldpose.deploy.cli import main
from fieldpose.deploy.graph import RECORDER
from fieldpose.deploy.plan import Plan, resolve
from fieldpose.deploy.processes.pipeline import Run, recorded_by
from fieldpose.deploy.processes.programs import programs
from fieldpose.deploy.processes.supervision import Supervisor
from fieldpose.deploy.recording_options import RecordingOptions
from fieldpose.deploy.settings import Settings
from fieldpose.errors import RecordingError

FULL = OSError(28, "No space left on device")


class Watched:
    """A supervisor whose recorder has run, and said something in the end."""

    def has_run(self, name: str) -> bool:
        return name == RECORDER

    def last_line(self, name: str) -> str:
        return "it was struck by lightning"

    def failure(self, name: str) -> str | None:
        return None


class Failed(Watched):
    """One whose recorder has ended with USER_ERROR."""

    def failure(self, name: str) -> str | None:
        return self.last_line(name)


SUPERVISOR = cast(Supervisor, Watched())
FAILED = cast(Supervisor, Failed())


def recorded(path: Path) -> RecordingWriter:
    writer = RecordingWriter(path)
    for number in range(3):
        message = truth(number)
        message.header = Header("camera", number, number, 0, number, number)
        writer.write(ADDRESS.key(TRUTH), TRUTH, message, number)
    return writer


@pytest.fixture
def plan() -> Plan:
    return resolve(Settings(), None, Path("field"))


def test_a_recording_that_ended_early_is_told_with_what_is_in_it(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    run = Run((), path)
    assert recorded(path).close()
    assert recorded_by(run, SUPERVISOR) == (info(path), None)
    path.unlink()
    recorded(path).end_early(FULL)
    held, error = recorded_by(run, SUPERVISOR)
    assert held is not None
    assert held.messages == 3
    assert error == f"{path}: the recording ended early: No space left on device; what came before is in it"


def test_a_recording_that_was_not_finished_is_told_with_the_recorders_last_words(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    recorded(path).flush()
    told = (None, f"{path}: the recording was not finished: it was struck by lightning")
    assert recorded_by(Run((), path), SUPERVISOR) == told
    partial_path(path).rename(aside_path(path))
    assert recorded_by(Run((), path), SUPERVISOR) == told


def test_a_run_without_a_recording_has_none(tmp_path: Path) -> None:
    run = Run((), None, recording=RecordingOptions(snapshots=tmp_path))
    assert run.recorded
    assert recorded_by(run, SUPERVISOR) == (None, None)


def test_what_became_of_snapshots_is_told_where_a_recording_is_whole_and_where_there_is_none(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    recorded(path).close()
    kept = RecordingOptions(snapshots=tmp_path)
    assert recorded_by(Run((), path, recording=kept), FAILED) == (info(path), "it was struck by lightning")
    assert recorded_by(Run((), None, recording=kept), FAILED) == (None, "it was struck by lightning")


class Bugged(RecordingWriter):
    """A store with a mistake that comes to light at the second message."""

    def write_payload(self, *message: Any) -> None:
        if self.messages:
            raise KeyError("nobody thought of it")
        super().write_payload(*message)


@pytest.mark.parametrize("snapshots", [False, True])
def test_a_mistake_of_ours_ends_a_recording_as_a_full_disk_does(tmp_path: Path, snapshots: bool) -> None:
    bus, path = MemoryBus(), tmp_path / "run.mcap"
    kept = Snapshots(SnapshotConfig(tmp_path / "kept")) if snapshots else None
    recorder = Recorder(bus, Address("test", "*", "*"), lambda: Bugged(path), kept)
    outbox = Outbox(bus, ADDRESS, "tracking")
    while recorder.error is None:
        outbox.publish(GUESS, guess(0))
    outbox.publish(GUESS, guess(0))
    with pytest.raises(RecordingError, match="the recording ended early: KeyError: 'nobody thought of it'"):
        recorder.close()
    # Nothing that comes is heaped up for a file that is closed.
    assert recorder.ended != snapshots
    assert info(path).messages == 1
    assert not info(path).lossless
    held, error = recorded_by(Run((), path), SUPERVISOR)
    assert held is not None
    assert error is not None
    assert error.startswith(f"{path}: the recording ended early: KeyError: ")


def test_a_recorder_that_can_keep_nothing_for_snapshots_ends_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bus = MemoryBus()
    snapshots = Snapshots(SnapshotConfig(tmp_path / "kept"))
    monkeypatch.setattr(snapshots, "add", lambda *message: message[99])
    recorder = Recorder(bus, Address("test", "*", "*"), None, snapshots)
    outbox = Outbox(bus, ADDRESS, "tracking")
    while not recorder.ended:
        outbox.publish(GUESS, guess(0))
    with pytest.raises(RecordingError, match="no snapshots are kept any more: IndexError: "):
        recorder.close()


def test_a_loss_that_could_not_be_saved_is_told_at_the_end_of_a_whole_recording(tmp_path: Path) -> None:
    bus, path, folder = MemoryBus(), tmp_path / "run.mcap", tmp_path / "kept"
    options = RecordingOptions(snapshots=folder)
    options.check(path)
    recorder = Recorder(bus, Address("test", "*", "*"), lambda: RecordingWriter(path), options.keep())
    folder.rmdir()
    folder.write_text("in the way")
    outbox = Outbox(bus, ADDRESS, "tracking")
    for which in (TrackingState.TRACKING, TrackingState.LOST):
        outbox.publish(STATE, msgspec.structs.replace(every_message()[STATE], state=which))
    with pytest.raises(RecordingError, match=r"kept/lost-.*\.mcap\.partial: cannot be written: File exists"):
        recorder.close()
    assert info(path).lossless
    assert info(path).messages == 2


class Failing(RecordingWriter):
    """A store on a disk that is full from the second message on."""

    def write_payload(self, *message: Any) -> None:
        if self.messages:
            raise FULL
        super().write_payload(*message)


def test_a_recorder_that_has_ended_says_so_once_and_goes_on_with_snapshots(tmp_path: Path) -> None:
    bus, path = MemoryBus(), tmp_path / "run.mcap"

    def opened() -> Store:
        return Failing(path)

    snapshots = Snapshots(SnapshotConfig(tmp_path / "kept"))
    handler = RecorderHandler(bus, Address("test", "*", "*"), opened, snapshots)
    outbox = Outbox(bus, ADDRESS, "tracking")
    for number in range(3):
        outbox.publish(GUESS, guess(number))
    said: list[str] = []
    while not said:
        try:
            handler.tick(0)
        except RecordingError as error:
            said.append(str(error))
    assert "the recording ended early: No space left on device" in said[0]
    assert list(handler.tick(0)) == []
    with pytest.raises(RecordingError, match="No space left on device"):
        handler.stop()
    assert info(path).messages == 1
    assert snapshots.save(10.0).messages == 3


@pytest.mark.parametrize(
    "recording", [RecordingOptions(), RecordingOptions(split="1GB"), RecordingOptions("10min", "both")]
)
def test_how_to_record_is_passed_on_to_the_recorder(tmp_path: Path, plan: Plan, recording: RecordingOptions) -> None:
    from fieldpose.deploy.cli import parse
    from fieldpose.deploy.commands import stage

    made = programs([plan], tmp_path, "tcp/127.0.0.1:1", tmp_path / "run.mcap", recording)
    (words,) = [list(program.command) for program in made if program.name == RECORDER]
    options = parse(stage.Options, "stage", words[words.index("stage") + 1 :])
    assert (options.record, options.recording) == (tmp_path / "run.mcap", recording)


def test_snapshots_alone_need_a_recorder_too(tmp_path: Path, plan: Plan) -> None:
    kept = RecordingOptions(snapshots=tmp_path / "kept", ring="5s", when_lost=False)
    (words,) = [
        list(program.command)
        for program in programs([plan], tmp_path, "tcp/127.0.0.1:1", None, kept)
        if program.name == RECORDER
    ]
    assert ("--record.snapshots", str(tmp_path / "kept")) in pairwise(words)
    assert "--record.no-when-lost" in words
    assert "--record" not in words


@pytest.mark.parametrize("name", ["run.mcap", "run.mcap.partial", "run.mcap.partial.before"])
def test_nothing_is_started_where_a_file_is_in_the_way(
    tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    field = save_empty_field(tmp_path / "field.safetensors")
    (tmp_path / name).write_text("mine")
    arguments = ["--source", "camera:0", "--record", str(tmp_path / "run.mcap")]
    assert main(["run", str(field), *arguments]) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith(f"fieldpose: {tmp_path / name}: ")
    assert (f"`fieldpose recover {tmp_path / name}`" in said) == (name != "run.mcap")
    assert (tmp_path / name).read_text() == "mine"
    assert {path.name for path in tmp_path.iterdir()} == {"field.safetensors", name}


@pytest.mark.parametrize("folder", ["file", "file/below", "/proc/nowhere"])
def test_nothing_is_started_where_no_snapshots_can_be_written(
    tmp_path: Path, folder: str, capsys: pytest.CaptureFixture[str]
) -> None:
    field = save_empty_field(tmp_path / "field.safetensors")
    (tmp_path / "file").write_text("mine")
    arguments = ["--source", "camera:0", "--record.snapshots", str(tmp_path / folder)]
    assert main(["run", str(field), *arguments]) == 2
    said = capsys.readouterr().err.splitlines()
    assert said[-1].startswith(f"fieldpose: {tmp_path / folder}: no snapshots can be written there: ")
    assert (tmp_path / "file").read_text() == "mine"


def test_a_report_reads_one_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    field = save_empty_field(tmp_path / "field.safetensors")
    arguments = ["--source", "camera:0", "--report", str(tmp_path / "page"), "--record.split", "1GB"]
    assert main(["run", str(field), *arguments]) == 2
    assert "--report reads one recording of fieldpose's own" in capsys.readouterr().err


def test_the_demo_replaces_no_recording_but_a_demos(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recorded(tmp_path / "recording.mcap").close()
    assert main(["demo", "--out", str(tmp_path)]) == 2
    assert "is no recording of a demo; give another --out" in capsys.readouterr().err
    assert info(tmp_path / "recording.mcap").messages == 3
