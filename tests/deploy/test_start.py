"""`fieldpose start`: from a video to poses in one command, which goes on where it was ended."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.commands import fieldpose
from support.papered_room import photograph

from fieldpose.deploy.cli import main
from fieldpose.deploy.commands.start import _identity
from fieldpose.stages.geometry import Camera, look_at

LENS = Camera(320, 240, 267.0, 267.0, 159.5, 119.5)


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("video") / "walk.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 10.0, (LENS.width, LENS.height))  # type: ignore[attr-defined]
    for along in np.linspace(-0.6, 0.6, 20):
        eye = (-0.6 + 0.5 * np.cos(along), 0.8 * along, 0.2 * np.sin(3 * along))
        picture = photograph(LENS, look_at(eye, (1.8, 1.0, -0.2), (0, 0, 1)))
        writer.write(cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    writer.release()
    return path


def test_a_video_becomes_poses_and_what_is_there_is_not_done_again(video: Path, tmp_path: Path) -> None:
    out, told = tmp_path / "room", tmp_path / "told.json"
    given = ("start", video, "--out", out, "--minutes", "0.25", "--json", told)
    first = fieldpose(*given, cwd=tmp_path, timeout_s=500)
    assert first.returncode == 0, first.stderr
    steps = json.loads(told.read_text())["steps"]
    assert [step["step"] for step in steps] == ["capture", "train"]
    assert all(step["seconds"] > 0 and step["peak_mb"] > 50 for step in steps)
    assert {"dataset", "field.safetensors", "field.mp4", "field.jpg", "start.json"} <= {p.name for p in out.iterdir()}
    assert "next: the same command with --on" in first.stdout
    learnt = (out / "field.safetensors").stat().st_mtime_ns
    second = fieldpose(*given, "--on", video, cwd=tmp_path, timeout_s=500)
    assert second.returncode == 0, second.stderr
    steps = json.loads(told.read_text())["steps"]
    assert [(step["step"], step["seconds"] is None) for step in steps] == [
        ("capture", True), ("train", True), ("run", False)
    ]  # fmt: skip
    assert (out / "field.safetensors").stat().st_mtime_ns == learnt
    rows = list(csv.DictReader((out / "run-walk" / "poses.csv").read_text().splitlines()))
    assert len(rows) == 20
    assert sum(bool(row["cam_from_object_00"]) for row in rows) > 10
    assert {"run.json", "timeline.png"} <= {p.name for p in (out / "run-walk").iterdir()}
    other = fieldpose("start", video, "--out", out, "--marker", "0.1", cwd=tmp_path)
    assert other.returncode == 2
    assert "holds what was captured of another source, or with another marker" in other.stderr


def test_a_capture_that_failed_is_done_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What a failed capture left is taken away, and nothing else."""
    source, out = tmp_path / "photos", tmp_path / "out"
    source.mkdir()
    cv2.imwrite(str(source / "a.png"), np.zeros((40, 40, 3), np.uint8))
    for _ in range(2):
        assert main(["start", str(source), "--out", str(out)]) == 2
        assert "take more photographs" in capsys.readouterr().err
        assert not out.exists()


def test_a_field_is_never_learnt_anew_without_being_asked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    (out / "dataset").mkdir(parents=True)
    (out / "dataset" / "transforms.json").write_text("{}")
    (out / "field.safetensors").write_bytes(b"learnt for hours")
    (tmp_path / "photos").mkdir()
    made_of = {"source": _identity(str(tmp_path / "photos")), "marker": None, "family": "4x4"}
    learnt = {"dataset": "{}", "minutes": 60.0, "only": None}
    (out / "start.json").write_text(json.dumps({"capture": made_of, "train": learnt}))
    given = ["start", str(tmp_path / "photos"), "--out", str(out)]
    for options in (["--only", "masks"], ["--minutes", "5"]):
        assert main([*given, *options]) == 2
        assert "name another --out, or remove it to learn anew" in capsys.readouterr().err
    assert main(given) == 0
    assert (out / "field.safetensors").read_bytes() == b"learnt for hours"


def test_a_source_that_has_changed_is_another(tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    (folder / "a.jpg").write_bytes(b"1")
    before = _identity(f"folder:{folder}")
    assert before == _identity(str(folder))
    (folder / "a.jpg").write_bytes(b"22")
    assert before != _identity(f"folder:{folder}")
    assert _identity("camera:0") == ["camera:0"]


def test_folders_of_others_are_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "mine"
    out.mkdir()
    (out / "precious.txt").write_text("mine")
    assert main(["start", "camera:7", "--out", str(out)]) == 2
    assert "not made by `fieldpose start`" in capsys.readouterr().err
    assert [path.name for path in out.iterdir()] == ["precious.txt"]
    assert main(["start", "nothing.mp4", "--out", str(tmp_path / "new"), "--minutes", "0"]) == 2
    assert "must be more than 0" in capsys.readouterr().err
    assert main(["start", "camera:7", "--out", str(tmp_path / "new"), "--on", "no.mp4"]) == 2
    assert "--on no.mp4: no such file" in capsys.readouterr().err
    assert main(["start", "nothing.mp4"]) == 2
    assert "nothing.mp4: no such file" in capsys.readouterr().err
    assert not (tmp_path / "new" / "dataset").exists()
