"""The command line: help, options, exit codes, and the user's mistakes in one line each."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from safetensors.numpy import save_file
from support.commands import fieldpose, save_empty_field

from fieldpose.deploy.cli import COMMANDS, main, parse
from fieldpose.deploy.commands import run, stage
from fieldpose.deploy.graph import BY_NAME
from fieldpose.errors import UsageError


@pytest.fixture
def field(tmp_path: Path) -> Path:
    return save_empty_field(tmp_path / "field.safetensors")


def only_line(capsys: pytest.CaptureFixture[str]) -> str:
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1, lines
    return lines[0]


@pytest.mark.parametrize("name", ["recorder", "camera", "tracking"])
def test_a_stage_plans_by_what_the_field_remembers(name: str, field: Path) -> None:
    """So that the recorder keeps what was decided, and the camera waits for no process that has nothing to do."""
    plan, _ = stage.planned(stage.Options(name, field=field), BY_NAME[name])
    assert not plan.looks
    assert "train it again" in plan.notes["retrieval"]


@pytest.mark.parametrize("options", [stage.Options("pnp"), stage.Options("camera", wait_for=("observer",))])
def test_a_stage_without_a_use_for_the_field_does_not_read_it(options: stage.Options, tmp_path: Path) -> None:
    unread = tmp_path / "unread.safetensors"
    plan, read = stage.planned(replace(options, field=unread), BY_NAME[options.name])
    assert (plan.field, read) == (unread, None)


def test_help_lists_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    said = capsys.readouterr().out
    assert all(f"  {name} " in said for name in COMMANDS)


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_each_command_describes_itself_with_an_example(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main([name, "--help"])
    assert ended.value.code == 0
    assert f"Example: fieldpose {name}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["runn"], "no command 'runn' (did you mean run?); expected one of demo, start, capture, convert"),
        (["run", "f", "--nonsense", "3"], "Unrecognized options: --nonsense"),
        (["run", "f", "--tracking.deth", "3"], "did you mean --tracking.depth?"),
        (["run"], "no field; give one, or several"),
        (["run", "f", "--depth", "many"], "--depth"),
        (["stage", "cooking"], "'cooking'"),
        (["info", "nothing.mcap"], "nothing.mcap: cannot be read: No such file"),
        (["recover", "nothing.mcap"], "nothing.mcap: cannot be read"),
        (["export", "nothing.mcap", "--foxglove", "a.mcap"], "nothing.mcap: cannot be read: No such file"),
        (["bridge", "rviz"], "Unrecognized options: rviz"),
        (["run", "nothing.safetensors", "--source", "camera:0"], "nothing.safetensors: no such field file"),
        (["convert", "nothing", "out", "--to", "colmap"], "nothing: no such folder"),
        (["convert", "nothing", "out"], "--to"),
        (["convert", "nothing", ".", "--to", "gltf"], "--to"),
        (["train", "nothing", "--out", "f.safetensors"], "nothing: no such folder"),
        (["bridge", "ros2", "--connect", "tcp/127.0.0.1:7447"], "--router"),
        (["stage", "pnp", "--connect", "nowhere"], "'nowhere' is no address of a hub"),
        (["stage", "pnp", "--pipelines", "nothing.json"], "nothing.json: no such configuration file"),
        (["stage", "pnp", "--config", "nothing.toml"], "nothing.toml: no such configuration file"),
    ],
)
def test_mistakes_are_one_line_and_exit_code_2(
    arguments: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    # These change this very process.
    monkeypatch.setattr("fieldpose.deploy.commands.stage.log_to_stderr", lambda **options: None)
    monkeypatch.setattr("fieldpose.deploy.commands.stage.hold_to", lambda threads: None)
    assert main(arguments) == 2
    line = only_line(capsys)
    assert line.startswith("fieldpose: ")
    assert said in line


def test_a_text_file_is_no_field_and_neither_is_one_of_another_version(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = tmp_path / "notes.safetensors"
    text.write_text("not a field")
    assert main(["run", str(text), "--source", "camera:0"]) == 2
    assert "notes.safetensors: not a safetensors field file" in only_line(capsys)
    import numpy as np

    other = tmp_path / "other.safetensors"
    save_file({"table": np.zeros(1, np.float32)}, other, metadata={"version": "999", "fieldpose": "{}"})
    assert main(["run", str(other), "--source", "camera:0"]) == 2
    assert "other.safetensors: field format version 999" in only_line(capsys)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "no source of images; give --source"),
        (["--source", "tape:1"], "source 'tape:1': expected one of folder:DIR"),
        (["--source", "camera:0", "--record", "."], "is a folder; give the name of a file"),
        (["--source", "camera:0", "--address.camera", "a/b"], "a part of a key has letters"),
    ],
)
def test_a_run_that_cannot_begin_starts_nothing(
    field: Path, arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", str(field), *arguments]) == 2
    assert said in only_line(capsys)


def test_an_unfinished_recording_is_in_the_way(field: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.mcap.partial").write_bytes(b"")
    assert main(["run", str(field), "--source", "camera:0", "--record", str(tmp_path / "a.mcap")]) == 2
    assert "an unfinished recording is in the way" in only_line(capsys)


def test_flags_win_over_the_file_and_the_file_over_the_defaults(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_text('[matching]\nmatcher = "sift"\nmax_keypoints = 99\n[tracking]\ndepth = 5\n')
    options = parse(run.Options, "run", ["f", "--config", str(path), "--source", "camera:0", "--depth", "3"])
    settings = options.with_shortcuts()
    assert (settings.matching.matcher, settings.matching.max_keypoints) == ("sift", 99)
    assert settings.tracking.depth == 3
    options = parse(run.Options, "run", ["f", f"--config={path}", "--matching.matcher", "loftr"])
    assert options.settings.matching.matcher == "loftr"
    assert parse(stage.Options, "stage", ["pnp"]).settings.matching.matcher == "xfeat"


def test_a_camera_sends_no_true_poses_of_another_object_than_its_own(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("fieldpose.deploy.commands.stage.log_to_stderr", lambda **options: None)
    monkeypatch.setattr("fieldpose.deploy.commands.stage.hold_to", lambda threads: None)
    assert main(["stage", "camera", "--camera.source", "bus", "--camera.truth-of", "can"]) == 2
    assert "truth_of is can, but this camera is of the object object" in capsys.readouterr().err


def test_short_flags_are_the_long_ones(tmp_path: Path) -> None:
    short = ["--source", "folder:x", "--guess", "train:a", "--size", "64", "--pace", "fast", "--passes", "2"]
    options = parse(run.Options, "run", ["f", *short, "--matcher", "sift", "--refine", "never"])
    settings = options.with_shortcuts()
    assert (options.field, options.source) == (("f",), ("folder:x",))
    assert (settings.camera.size, settings.camera.pace) == (64, "fast")
    assert (settings.tracking.guess, settings.tracking.passes) == ("train:a", 2)
    assert settings.matching.matcher == "sift"
    assert settings.refinement.when == "never"
    video = parse(run.Options, "run", ["f", "--source", "x", "--sequence", "video"]).with_shortcuts()
    assert video.tracking.sequence == "video"


def test_parsing_raises_for_the_caller_to_print() -> None:
    with pytest.raises(UsageError, match="see `fieldpose stage --help`"):
        parse(stage.Options, "stage", ["pnp", "--zzz"])


@pytest.fixture
def taken_port() -> Iterator[int]:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        yield taken.getsockname()[1]


def test_a_port_in_use_is_told(field: Path, taken_port: int, capsys: pytest.CaptureFixture[str]) -> None:
    hub = f"tcp/127.0.0.1:{taken_port}"
    assert main(["run", str(field), "--source", "camera:0", "--listen", hub]) == 2
    assert f"cannot listen on {hub}: the port is in use" in capsys.readouterr().err


def test_in_real_processes_a_port_in_use_is_told_by_the_hub_too(taken_port: int, tmp_path: Path) -> None:
    ended = fieldpose("stage", "hub", "--listen", f"tcp/127.0.0.1:{taken_port}", cwd=tmp_path)
    assert ended.returncode == 2
    assert ended.stderr.splitlines()[-1].startswith(f"fieldpose: no hub at tls/127.0.0.1:{taken_port}")
    assert "Traceback" not in ended.stderr


def test_in_real_processes_an_unreadable_video_is_told(field: Path, tmp_path: Path) -> None:
    (tmp_path / "film.mp4").write_bytes(b"no film")
    ended = fieldpose("run", field, "--source", "video:film.mp4", "--json", "out.json", cwd=tmp_path)
    assert ended.returncode == 2
    assert "camera: film.mp4: not a video" in ended.stderr.splitlines()[-1]
    assert "Traceback" not in ended.stderr
    assert not (tmp_path / "out.json").exists()


def test_in_real_processes_missing_weights_are_told(field: Path, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "image.png"), np.zeros((32, 32, 3), np.uint8))
    ended = fieldpose("run", field, "--source", "folder:.", "--matching.weights", "none.pt", cwd=tmp_path)
    assert ended.returncode == 2
    assert "matching: no weights at none.pt" in ended.stderr.splitlines()[-1]
    assert "Traceback" not in ended.stderr


def test_doctor_finds_what_is_missing_and_writes_its_findings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from fieldpose.deploy import checks

    monkeypatch.setattr(checks, "weights", lambda: iter(()))
    path = tmp_path / "findings.json"
    assert main(["doctor", "--json", str(path), "--dataset", str(tmp_path / "nothing")]) == 1
    findings = {finding["what"]: finding for finding in json.loads(path.read_text())}
    assert findings["bus"]["status"] == "ok", findings["bus"]
    assert findings["dataset"]["status"] == "failed"
    assert "no such folder" in findings["dataset"]["detail"]
    assert "ms" in capsys.readouterr().out


def test_a_folder_for_logs_that_cannot_be_made_is_told(field: Path, tmp_path: Path, capsys: Any) -> None:
    (tmp_path / "taken").write_text("a file")
    assert main(["run", str(field), "--source", "camera:0", "--logs", str(tmp_path / "taken")]) == 2
    assert "no folder for logs" in capsys.readouterr().err
