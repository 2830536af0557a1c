"""The command that converts datasets: what it says, and what it refuses."""

from __future__ import annotations

from pathlib import Path

import pytest
from support import posed_images as made

from fieldpose.deploy.cli import main
from fieldpose.stages.nerf.datasets import load_dataset

CAMERA = made.centred(32, 24, 30.0)


def test_it_says_what_was_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    poses = made.write_llff(tmp_path / "fern", CAMERA, factors=(1,))
    monkeypatch.chdir(tmp_path)
    assert main(["convert", "fern", "new/colmap", "--to", "colmap"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "new/colmap: 10 images of fern (llff), as colmap",
        "colmap has no place for: which images are held out, the nearest and farthest depths",
    ]
    made.assert_poses(load_dataset("new/colmap", "all"), poses, 1e-9)
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path / "empty")
    assert main(["convert", "../fern", ".", "--to", "transforms", "--holdout", "odd", "--no-images"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        ".: 10 images of ../fern (llff), 5 of them held out, as transforms",
        "transforms has no place for: the nearest and farthest depths",
        "put the images into images",
    ]
    assert (tmp_path / "empty/transforms.json").is_file()


def test_what_is_there_already_stays(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made.write_transforms(tmp_path / "in", CAMERA)
    for out in (tmp_path / "in", tmp_path / "in/transforms.json"):
        assert main(["convert", str(tmp_path / "in"), str(out), "--to", "colmap"]) == 2
        assert capsys.readouterr().err == (
            f"fieldpose: {out}: is there already and not empty; name another folder, or remove it\n"
        )
    assert len(load_dataset(tmp_path / "in", "all")) == 7
