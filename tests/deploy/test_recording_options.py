"""How a recorder writes: options in clear units, Foxglove's form, parts, and what is refused before anything starts."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from support import bus_samples
from support.commands import command, save_empty_field
from support.foxglove import read_mcap

from fieldpose.bus.codec import encode
from fieldpose.bus.messages import Header
from fieldpose.bus.open_recording import partial_path
from fieldpose.bus.ports import Outbox
from fieldpose.bus.reading import info
from fieldpose.bus.recorder import Recorder
from fieldpose.bus.recording import RecordingWriter
from fieldpose.bus.recovery import recover
from fieldpose.bus.splitting import Split
from fieldpose.bus.tee import Tee
from fieldpose.bus.topics import ALL, STATE, Address
from fieldpose.bus.transport import Bus, MemoryBus, ZenohBus, wait_for
from fieldpose.deploy.cli import main
from fieldpose.deploy.foxglove.recording import FoxgloveRecording
from fieldpose.deploy.processes.endpoints import free_port
from fieldpose.deploy.recording_options import RecordingOptions, with_start
from fieldpose.errors import RecordingError, UsageError

ADDRESS = Address("fieldpose", "mug", "cam")
FILE = Path("run.mcap")


@pytest.mark.parametrize(
    ("text", "split"),
    [
        ("1GB", Split(max_bytes=10**9)),
        ("1.5 MiB", Split(max_bytes=3 << 19)),
        ("10min", Split(seconds=600.0)),
        ("500MB,90s", Split(500_000_000, 90.0)),
        ("2h, 1TB", Split(10**12, 7200.0)),
    ],
)
def test_sizes_and_times_have_clear_units(text: str, split: Split) -> None:
    assert RecordingOptions(split=text).parts() == split


@pytest.mark.parametrize("text", ["", "5", "1G", "10m", "-1GB", "1GB,2GB", "10kB", "0.1s", "1GB;10s", "infs"])
def test_others_are_refused_with_an_example(text: str) -> None:
    with pytest.raises(UsageError, match="split"):
        RecordingOptions(split=text).check(FILE)


@pytest.mark.parametrize(
    ("options", "record", "pipelines", "said"),
    [
        (
            RecordingOptions(snapshots=Path("x"), ring="1h"),
            None,
            1,
            "ring '1h': expected a time above 0",
        ),
        (RecordingOptions(snapshots=Path("x"), ring_size="5kB"), None, 1, "ring-size '5kB': expected at least 1MB"),
        (RecordingOptions(split="1GB"), None, 1, "give the file to record into"),
        (RecordingOptions(format="foxglove"), FILE, 2, "Foxglove's schemas hold one pipeline"),
        (RecordingOptions(format="both"), FILE, 0, "name it by --object and --camera"),
    ],
)
def test_what_cannot_be_is_told(options: RecordingOptions, record: Path, pipelines: int, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        options.check(record, pipelines)


def test_parts_have_room_for_more_than_settings_and_field() -> None:
    with pytest.raises(UsageError, match="each part also holds 8 MB of settings and field; make it 17MB or more"):
        RecordingOptions(split="10MB").check(FILE, attached=8_000_000)
    RecordingOptions(split="17MB").check(FILE, attached=8_000_000)


def test_without_the_extra_foxglove_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(UsageError, match=r"pip install 'fieldpose\[foxglove\]'"):
        RecordingOptions(format="foxglove").check(FILE)


@pytest.mark.parametrize("name", ["run.mcap", "run.mcap.partial", "run.mcap.partial.before", "run-foxglove.mcap"])
def test_no_recording_is_begun_where_a_file_is_in_the_way(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("somebody's")
    with pytest.raises(RecordingError, match=f"{name}: "):
        RecordingOptions(format="both").check(tmp_path / "run.mcap")
    (tmp_path / name).rename(tmp_path / name.replace(".mcap", "-000.mcap"))
    with pytest.raises(RecordingError, match="-000"):
        RecordingOptions(format="both", split="1GB").check(tmp_path / "run.mcap")


def publish_everything(bus: Bus, times: int = 1) -> None:
    outbox = Outbox(bus, ADDRESS, "stage")
    for _ in range(times):
        for topic, message in bus_samples.every_message().items():
            outbox.publish(topic, message)


def test_both_forms_are_recorded_at_once(tmp_path: Path) -> None:
    options, bus, path = RecordingOptions(format="both"), MemoryBus(), tmp_path / "run.mcap"
    recorder = Recorder(bus, ADDRESS, options.store(path, ADDRESS, {"run": {"id": "7"}}, from_start=True))
    publish_everything(bus, 3)
    assert recorder.close()
    foxglove = tmp_path / "run-foxglove.mcap"
    assert set(tmp_path.iterdir()) == {path, foxglove}
    assert info(path).messages == 3 * len(ALL)
    exported = tmp_path / "exported.mcap"
    assert main(["export", str(path), "--foxglove", str(exported)]) == 0
    counts = [Counter({topic: len(read) for topic, read in read_mcap(file).items()}) for file in (foxglove, exported)]
    assert counts[0] == counts[1]
    assert counts[0]["/camera/image"] == 3
    assert info(foxglove).lossless


class Failing(FoxgloveRecording):
    """One whose disk fails at its end, on the way to it or by our own mistake."""

    def close(self, *whys: Any, **named: Any) -> bool:
        if not whys and not named:
            raise self.failure
        return super().close(*whys, **named)

    failure: Exception = OSError(5, "Input/output error")


@pytest.mark.parametrize("failure", [OSError(5, "Input/output error"), KeyError("x")])
@pytest.mark.parametrize("first", [False, True])
def test_of_both_forms_one_is_whole_where_the_other_fails_at_its_end(
    tmp_path: Path, first: bool, failure: Exception
) -> None:
    whole, failing = RecordingWriter(tmp_path / "run.mcap"), Failing(tmp_path / "foxglove.mcap", ADDRESS, None)
    failing.failure = failure
    bus = MemoryBus()
    recorder = Recorder(bus, ADDRESS, lambda: Tee([failing, whole] if first else [whole, failing]))
    publish_everything(bus)
    with pytest.raises(RecordingError, match=r"^\S*foxglove\.mcap: the recording ended early: [^;]*; [^;]*$"):
        recorder.close()
    assert info(tmp_path / "run.mcap").lossless
    assert info(tmp_path / "foxglove.mcap").ended is not None
    assert len(list(tmp_path.iterdir())) == 2


def test_of_both_forms_one_is_whole_where_a_file_has_come_in_the_way_of_the_other(tmp_path: Path) -> None:
    bus, path = MemoryBus(), tmp_path / "run.mcap"
    recorder = Recorder(bus, ADDRESS, RecordingOptions(format="both").store(path, ADDRESS))
    publish_everything(bus)
    path.write_text("somebody's")
    with pytest.raises(RecordingError, match="another file has come there; it is whole, as"):
        recorder.close()
    assert info(tmp_path / "run-foxglove.mcap").lossless
    assert path.read_text() == "somebody's"


@pytest.mark.parametrize("form", ["fieldpose", "foxglove"])
def test_a_recorder_that_may_go_on_begins_where_there_is_nothing_yet(tmp_path: Path, form: Any) -> None:
    bus = MemoryBus()
    path = tmp_path / "run.mcap"
    recorder = Recorder(bus, ADDRESS, RecordingOptions(format=form).store(path, ADDRESS, resume=True, from_start=True))
    publish_everything(bus)
    assert recorder.close()
    assert info(path).lossless


def write_everything(writer: FoxgloveRecording, numbers: range) -> None:
    for number in numbers:
        for topic, message in bus_samples.every_message().items():
            was = message.header
            message.header = Header("stage", number, was.frame_id, was.pass_index, was.capture_ns, number)
            writer.write_payload(ADDRESS.key(topic, "stage"), topic, encode(message), number)


def test_foxglove_in_parts_counts_what_is_missing_and_leaves_out_other_pipelines(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    options = RecordingOptions(format="foxglove", split="1GB,1s")
    opened = options.store(path, ADDRESS, from_start=True)
    assert opened is not None
    store = opened()
    for number, second in ((0, 0), (1, 0), (3, 2)):
        for address in (ADDRESS, Address("fieldpose", "can", "other")):
            message = bus_samples.every_message()[STATE]
            message.header = Header("tracking", number, number, 0, number, number)
            store.write_payload(address.key(STATE), STATE, encode(message), second * 10**9)
    assert not store.close()
    parts = [tmp_path / f"run-00{number}.mcap" for number in range(2)]
    assert sorted(tmp_path.iterdir()) == parts
    assert [len(read_mcap(part)["/state"]) for part in parts] == [2, 1]
    assert [info(part).lossless for part in parts] == [True, False]


def test_a_killed_recording_in_foxgloves_form_is_recovered_and_gone_on_from(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    killed = FoxgloveRecording(path, ADDRESS, None)
    write_everything(killed, range(3))
    killed.flush()
    assert not path.exists()
    saved = recover(partial_path(path), tmp_path / "saved.mcap")
    assert saved == killed.messages > 0
    assert len(read_mcap(tmp_path / "saved.mcap")["/camera/image"]) == 3
    again = FoxgloveRecording(path, ADDRESS, None, resume=True)
    again.take_over()
    write_everything(again, range(3, 5))
    again.close()
    assert len(read_mcap(path)["/camera/image"]) == 5
    assert not info(path).lossless
    assert set(tmp_path.iterdir()) == {path, tmp_path / "saved.mcap"}


def test_a_recorder_is_asked_for_what_came_last(hub: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bus = ZenohBus(hub)
    recorder = Recorder(bus, Address("fieldpose", "*", "*"), None, RecordingOptions(snapshots=tmp_path).keep())
    publish_everything(bus)
    bus.wait_for_hub(20.0)
    assert main(["record", "--snapshot", "10s", "--connect", hub, "--open"]) == 0
    (path,) = tmp_path.iterdir()
    assert capsys.readouterr().out.startswith(f"{path}: {len(ALL)} messages of the last 0.")
    assert main(["info", str(path)]) == 0
    assert "a snapshot of the last 0.0 s, saved when it was asked for" in capsys.readouterr().out
    assert recorder.close()
    bus.close()


def test_a_recorder_that_keeps_only_the_last_leaves_nothing_unasked(hub: str, tmp_path: Path) -> None:
    assert main(["record", "--snapshots", str(tmp_path), "--connect", hub, "--open", "--seconds", "0.3"]) == 0
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "nothing to do: give a file to record into"),
        (["--snapshot", "10"], "snapshot '10': expected a time above 0, at most 10min, as 10s"),
        (["a.mcap", "--snapshot", "10s"], "leave out what tells how to record"),
        (["a.mcap", "--format", "foxglove"], "name it by --object and --camera"),
    ],
)
def test_record_refuses_what_cannot_be(arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["record", *arguments]) == 2
    assert said in capsys.readouterr().err


def test_record_onto_a_file_is_refused_by_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.mcap").write_text("mine")
    assert main(["record", str(tmp_path / "a.mcap"), "--connect", f"tcp/127.0.0.1:{free_port()}"]) == 2
    assert f"{tmp_path / 'a.mcap'}: is there already" in capsys.readouterr().err
    assert (tmp_path / "a.mcap").read_text() == "mine"


def test_the_recorder_under_load_is_measured(tmp_path: Path) -> None:
    figures = tmp_path / "record.json"
    arguments = ["--seconds", "2", "--split", "20MB", "--width", "320", "--height", "240"]
    assert main(["bench", "record", *arguments, "--out", str(tmp_path / "out"), "--json", str(figures)]) == 0
    measured = json.loads(figures.read_text())
    assert measured["sent"] == measured["written"] == 60 * len(ALL)
    assert (measured["lost"], measured["missing_by_sequence"], measured["unwritten"]) == (0, 0, 0)
    assert measured["parts"] > 1
    assert measured["rss_mb"]["highest"] > 0
    assert list((tmp_path / "out").iterdir()) == []


@pytest.mark.slow
def test_a_recorder_that_is_started_again_has_a_file_of_its_own(hub: str, tmp_path: Path) -> None:
    field, record = save_empty_field(tmp_path / "field.safetensors"), tmp_path / "run-{start}.mcap"
    line = command("stage", "recorder", "--connect", hub, "--open", "--field", field, "--record", record)
    for count in (1, 2):
        recorder = subprocess.Popen(line)
        bus = ZenohBus(hub)
        try:
            wait_for(bus, Address(), ["recorder"], 60.0)
        finally:
            bus.close()
        recorder.send_signal(signal.SIGTERM)
        assert recorder.wait(timeout=30) == 0
        made = sorted(path.name for path in tmp_path.glob("run-*"))
        assert len(made) == count
        assert all(re.fullmatch(r"run-\d{8}-\d{6}\.mcap", name) for name in made)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_recorder_that_is_stopped_before_a_hub_is_there_finishes_its_file(
    number: signal.Signals, tmp_path: Path
) -> None:
    field, record = save_empty_field(tmp_path / "field.safetensors"), tmp_path / "run.mcap"
    hub = f"tcp/127.0.0.1:{free_port()}"
    line = command("stage", "recorder", "--connect", hub, "--open", "--field", field, "--record", record)
    recorder = subprocess.Popen(line)
    deadline = time.monotonic() + 60
    while not list(tmp_path.glob("run.mcap*")) and time.monotonic() < deadline:
        time.sleep(0.01)
    recorder.send_signal(number)
    assert recorder.wait(timeout=30) == 0
    assert [path.name for path in tmp_path.glob("run*")] == ["run.mcap"]
    assert info(record).attachments


def test_the_start_of_a_recorder_stands_in_its_files_name() -> None:
    at = time.strptime("2031-02-03 04:05:06", "%Y-%m-%d %H:%M:%S")
    assert with_start(Path("a/run-{start}.mcap"), at) == Path("a/run-20310203-040506.mcap")
    assert with_start(Path("a/run.mcap"), at) == Path("a/run.mcap")
