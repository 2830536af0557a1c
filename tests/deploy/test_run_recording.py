"""What a run does about its recorder: refuses what is in the way, passes on how to record, tells what went wrong."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import pytest
from support.bus_samples import ADDRESS, guess, truth
from support.commands import save_empty_field

from fieldpose.bus.memory import MemoryBus
from fieldpose.bus.messages import Header
from fieldpose.bus.open_recording import partial_path
from fieldpose.bus.ports import Outbox
from fieldpose.bus.reading import info
from fieldpose.bus.recorder import RecorderHandler, Store
from fieldpose.bus.recording import RecordingWriter
from fieldpose.bus.ring import SnapshotConfig, Snapshots
from fieldpose.bus.topics import GUESS, TRUTH, Address
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


SUPERVISOR = cast(Supervisor, Watched())


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
    assert recorded_by(Run((), path), SUPERVISOR) == (
        None, f"{path}: the recording was not finished: it was struck by lightning"
    )  # fmt: skip


def test_a_run_without_a_recording_has_none(tmp_path: Path) -> None:
    run = Run((), None, recording=RecordingOptions(snapshots=tmp_path))
    assert run.recorded
    assert recorded_by(run, SUPERVISOR) == (None, None)


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


@pytest.mark.parametrize("name", ["run.mcap", "run.mcap.partial"])
def test_nothing_is_started_where_a_file_is_in_the_way(
    tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    field = save_empty_field(tmp_path / "field.safetensors")
    (tmp_path / name).write_text("mine")
    arguments = ["--source", "camera:0", "--record", str(tmp_path / "run.mcap")]
    assert main(["run", str(field), *arguments]) == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith(f"fieldpose: {tmp_path / name}: ")
    assert (tmp_path / name).read_text() == "mine"
    assert partial_path(tmp_path / "run.mcap").exists() == (name != "run.mcap")


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
