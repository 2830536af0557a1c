"""A dataset's cameras are compared with its images before the training, and adjusted where they do not fit."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import numpy as np
import pytest
from support import posed_images
from support.papered_room import cameras_before_a_wall, disturbed, photograph, worst

from fieldpose.deploy.cameras import fit_cameras, in_words, kept_in_words
from fieldpose.deploy.cli import main
from fieldpose.stages.geometry import Camera
from fieldpose.stages.nerf.datasets import PosedCamera, load_dataset
from fieldpose.stages.nerf.field import load_field
from fieldpose.stages.nerf.metadata import CameraFit, FieldMetadata
from fieldpose.stages.structure.posed import PosedCameras
from fieldpose.stages.structure.similarity import align

CAMERA = Camera(400, 300, 280.0, 280.0, 199.5, 149.5)
TRUTH = cameras_before_a_wall(CAMERA, 10)
SMALL = [
    "--model.levels", "2", "--model.log2-table", "8", "--model.hidden", "8", "--model.colour-hidden", "8",
    "--model.occupancy-resolution", "16", "--model.finest-resolution", "32", "--training.steps", "1",
    "--turntable", "none",
]  # fmt: skip


def written(root: Path, given: PosedCameras) -> Path:
    """A dataset of the room with the true images and the given cameras."""
    frames = []
    for i, (pose, true) in enumerate(zip(given.cam_from_object, TRUTH.cam_from_object, strict=True)):
        posed_images.save(root / f"images/{i}.png", photograph(CAMERA, true))
        frames.append({"file_path": f"images/{i}.png", "transform_matrix": posed_images.opengl(pose)})
    posed_images.write_json(root / "transforms.json", posed_images.intrinsics(given.cameras[0]) | {"frames": frames})
    return root


def longer(posed: PosedCameras, factor: float) -> PosedCameras:
    cameras = (msgspec.structs.replace(CAMERA, fx=factor * CAMERA.fx, fy=factor * CAMERA.fy),) * len(posed)
    return PosedCameras(cameras, posed.cam_from_object)


def train(root: Path, *arguments: str) -> FieldMetadata:
    out = root / "field.safetensors"
    assert main(["train", str(root), "--out", str(out), "--size", "200", *SMALL, *arguments]) == 0
    return load_field(out).metadata


def test_cameras_that_fit_are_trained_on_to_the_bit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = written(tmp_path, TRUTH)
    metadata = train(root)
    assert "cameras fit their images: 0." in capsys.readouterr().err
    assert metadata.camera_fit is not None
    assert metadata.camera_fit.verdict == "fit"
    for camera, record in zip(metadata.cameras, load_dataset(root, "train", 200).images, strict=True):
        assert camera.camera == record.camera
        assert np.array_equal(camera.pose, record.cam_from_object)


def test_cameras_that_do_not_fit_are_adjusted_told_and_remembered(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root, figures = written(tmp_path, longer(disturbed(TRUTH, 0.5, 0.02), 1.05)), tmp_path / "figures.json"
    metadata = train(root, "--json", str(figures))
    said = capsys.readouterr().err
    assert "cameras: matching the images" in said
    assert "cameras adjusted to their images: 0." in said
    assert "focal length 294.0 -> 2" in said
    assert json.loads(figures.read_text())["cameras"]["verdict"] == "adjusted"
    found = np.stack([camera.pose for camera in metadata.cameras])
    true = PosedCameras((CAMERA,) * 5, TRUTH.cam_from_object[::2])
    there = align(found, true.cam_from_object).of_poses(found)
    turned, moved = worst(PosedCameras(true.cameras, there), true)
    assert turned < 0.2
    assert moved < 0.01
    assert metadata.cameras[0].fx == pytest.approx(140, rel=0.02)
    assert main(["doctor", "--field", str(root / "field.safetensors")]) in (0, 1)
    assert "cameras adjusted to their images" in capsys.readouterr().out


def test_held_out_images_are_adjusted_as_well(tmp_path: Path) -> None:
    root = written(tmp_path, disturbed(TRUTH, 0.5, 0.02))
    fitted = fit_cameras(load_dataset(root, "train", 200), "auto", threads=1)
    assert fitted.cameras is not None
    test = load_dataset(root, "test", 200, cameras=fitted.cameras)
    assert [record.name for record in test.images] == [f"images/{i}.png" for i in range(1, 10, 2)]
    poses = np.stack([camera.cam_from_object for camera in fitted.cameras])
    there = align(poses, TRUTH.cam_from_object)
    found = PosedCameras(
        TRUTH.cameras[::2], there.of_poses(np.stack([record.cam_from_object for record in test.images]))
    )
    turned, moved = worst(found, PosedCameras(TRUTH.cameras[::2], TRUTH.cam_from_object[1::2]))
    assert turned < 0.2
    assert moved < 0.01


def test_given_cameras_are_not_looked_at(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = written(tmp_path, disturbed(TRUTH, 0.5, 0.02))
    metadata = train(root, "--cameras", "given")
    assert metadata.camera_fit is None
    assert "cameras" not in capsys.readouterr().err
    assert np.array_equal(metadata.cameras[0].pose, load_dataset(root).images[0].cam_from_object)


def test_images_that_share_too_little_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    posed_images.write_blender(tmp_path, posed_images.centred(32, 32, 40.0))
    metadata = train(tmp_path)
    assert "whether the cameras fit their images is not known: 9 images share too little" in capsys.readouterr().err
    assert metadata.camera_fit is not None
    assert metadata.camera_fit.verdict == "too few"
    assert np.array_equal(metadata.cameras[0].pose, load_dataset(tmp_path).images[0].cam_from_object)


def test_cameras_of_a_dataset_are_replaced_at_every_size(tmp_path: Path) -> None:
    root = written(tmp_path, TRUTH)
    half = longer(disturbed(TRUTH, 1.0, 0.1), 1.1)
    cameras = [
        PosedCamera(camera.resized(200, 150), pose)
        for camera, pose in zip(half.cameras, half.cam_from_object, strict=True)
    ]
    found = load_dataset(root, "all", 100, cameras=cameras)
    assert found.images[3].camera.fx == pytest.approx(0.25 * 308)
    assert np.array_equal(found.images[3].cam_from_object, half.cam_from_object[3])
    assert found.content_hash() != load_dataset(root, "all", 100).content_hash()


def test_what_became_of_cameras_is_one_line() -> None:
    common = {"size_px": 640, "focal_px": (576.7, 524.7), "before_px": 6.957, "after_px": 0.493}
    adjusted = CameraFit("adjusted", **common, rotation_deg=(0.5, 0.88), translation=(0.02, 0.037))  # type: ignore[arg-type]
    assert in_words(adjusted, "metre") == (
        "cameras adjusted to their images: 0.50 degrees and 0.02 in the median, 0.88 and 0.037 at most (lengths in:"
        " metre), focal length 576.7 -> 524.7 px, error 6.96 -> 0.49 px (in images of 640 px)"
    )
    calibrated = msgspec.structs.replace(adjusted, focal_px=(524.7, 524.7))
    assert "focal" not in in_words(calibrated, "metre")
    lens = msgspec.structs.replace(adjusted, rotation_deg=(0.0, 0.0), translation=(0.0, 0.0))
    assert "images: poses stay, focal length 576.7 -> 524.7 px, error" in in_words(lens, "metre")
    assert kept_in_words(adjusted) is None
    assert (
        kept_in_words(msgspec.structs.replace(adjusted, kept=("a", "b")))
        == "2 images share too little with others and keep their cameras, as blurred ones do: a, b"
    )
    assert "do not fit their images: 7.0 px" in in_words(CameraFit("no fit", **common), "metre")  # type: ignore[arg-type]
    assert "cameras fit their images: 6.96 px" in in_words(CameraFit("fit", **common), "metre")  # type: ignore[arg-type]
