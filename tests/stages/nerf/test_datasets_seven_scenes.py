"""7-Scenes as it is unpacked: whole scenes with their splits, single sequences, and what is wrong with them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support import posed_images as made
from support import recorded

from fieldpose.errors import DatasetError
from fieldpose.stages.geometry import Camera
from fieldpose.stages.nerf.datasets import load_dataset

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5).resized(32, 24)


def scene(root: Path) -> dict[str, list[np.ndarray]]:
    """Sequences 1 and 10 are for training, 2 is for tests, 3 in no split."""
    poses = {f"seq-{n:02d}": recorded.write_seven_scenes(root / f"seq-{n:02d}", CAMERA, 4, n) for n in (1, 2, 3, 10)}
    recorded.text(root / "TrainSplit.txt", "sequence1 \nsequence10 \n")
    recorded.text(root / "TestSplit.txt", "sequence2\n")
    return poses


def test_a_sequence(tmp_path: Path) -> None:
    poses = recorded.write_seven_scenes(tmp_path, CAMERA)
    dataset = load_dataset(tmp_path, "all")
    assert (dataset.kind, dataset.scene, dataset.unit, dataset.metres_per_unit) == ("7scenes", "unbounded", "m", 1.0)
    made.assert_poses(dataset, poses, 1e-9)
    assert dataset.images[0].camera == CAMERA
    assert dataset.images[3].name == "frame-000003.color.png"
    assert made.worst_dot_px(dataset) < 0.1
    assert [record.split for record in dataset.images] == ["test", *["train"] * 7, "test"]
    (note,) = dataset.notes
    assert "525 px at 640x480 and a centred principal point are assumed; a camera.json in" in note


def test_a_scene_with_its_splits(tmp_path: Path) -> None:
    poses = scene(tmp_path)
    train, test = load_dataset(tmp_path), load_dataset(tmp_path, "test")
    made.assert_poses(train, poses["seq-01"] + poses["seq-10"], 1e-9)
    made.assert_poses(test, poses["seq-02"], 1e-9)
    assert test.images[0].name == "seq-02/frame-000000.color.png"
    assert "in no split, and left out: seq-03" in train.notes
    (tmp_path / "TrainSplit.txt").unlink()
    (tmp_path / "TestSplit.txt").unlink()
    assert len(load_dataset(tmp_path, "all")) == 16
    assert len(load_dataset(tmp_path, "test", holdout="odd")) == 8


def test_lost_frames_are_left_out(tmp_path: Path) -> None:
    poses = recorded.write_seven_scenes(tmp_path, CAMERA)
    recorded.text(tmp_path / "frame-000002.pose.txt", "nan nan nan nan\n" * 4)
    recorded.text(tmp_path / "frame-000005.pose.txt", recorded.rows(np.full((4, 4), np.inf)))
    dataset = load_dataset(tmp_path, "all")
    made.assert_poses(dataset, [pose for i, pose in enumerate(poses) if i not in (2, 5)], 1e-9)
    assert dataset.notes[0] == (
        "2 of 9 images are left out (the pose is lost, not finite): frame-000002.pose.txt, frame-000005.pose.txt"
    )
    for path in tmp_path.glob("*.pose.txt"):
        recorded.text(path, "nan nan nan nan\n" * 4)
    with pytest.raises(DatasetError, match="none of its 9 poses is finite"):
        load_dataset(tmp_path)


def test_depth_of_the_other_camera_is_not_taken_for_truth(tmp_path: Path) -> None:
    recorded.write_seven_scenes(tmp_path, CAMERA)
    for i in range(9):
        made.save(tmp_path / f"frame-{i:06d}.depth.png", np.full((24, 32), 4000, np.uint16))
    dataset = load_dataset(tmp_path)
    assert any("depth is that of a second camera" in note for note in dataset.notes)
    with pytest.raises(DatasetError, match="has no depth for this image"):
        dataset.load_depth(0)


def test_a_calibration_beside_the_images_is_taken(tmp_path: Path) -> None:
    recorded.write_seven_scenes(tmp_path, CAMERA)
    camera = {"width": 64, "height": 48, "fx": 60.0, "fy": 61.0, "cx": 30.0, "cy": 24.0}
    made.write_json(tmp_path / "camera.json", camera)
    dataset = load_dataset(tmp_path)
    assert dataset.images[0].camera == Camera(**camera).resized(32, 24)  # type: ignore[arg-type]
    assert not dataset.notes
    made.write_json(tmp_path / "camera.json", camera | {"height": 64})
    with pytest.raises(DatasetError, match=r"color\.png: the image has 32x24 pixels, its camera 64x64, another shape"):
        load_dataset(tmp_path)
    made.write_json(tmp_path / "camera.json", camera | {"fx": "wide"})
    with pytest.raises(DatasetError, match=r"camera\.json: no usable camera file"):
        load_dataset(tmp_path)


@pytest.mark.parametrize(
    ("file", "content", "said"),
    [
        ("TestSplit.txt", "sequence7\n", r"TestSplit\.txt: line 1: there is no .*seq-07; unpack it"),
        ("TestSplit.txt", "chess\n", r"TestSplit\.txt: line 1: 'chess' is no sequence"),
        ("TestSplit.txt", "sequence1\n", r"TestSplit\.txt: line 1: sequence1 is in both splits"),
        ("TestSplit.txt", "\n", r"TestSplit\.txt: it is empty"),
        ("seq-01/frame-000001.pose.txt", "1 0 0 0\n0 1 0 0\n0 0 1 0\n", r"0001\.pose\.txt: expected 4 rows of 4"),
        ("seq-01/frame-000001.pose.txt", "1 0 0\n", r"0001\.pose\.txt: line 1: expected 4 numbers, got '1 0 0'"),
        ("seq-01/frame-000001.pose.txt", "1 0 0 x\n" * 4, r"pose\.txt: line 1: could not convert string to float: 'x'"),
        ("seq-01/frame-000001.pose.txt", recorded.rows(np.diag([1, 1, -1, 1])), r"pose\.txt: the pose is not rigid"),
        ("seq-01/frame-000009.pose.txt", recorded.rows(np.eye(4)), r"no image frame-000009\.color\.png beside it"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, file: str, content: str, said: str) -> None:
    scene(tmp_path)
    recorded.text(tmp_path / file, content)
    with pytest.raises(DatasetError, match=said) as caught:
        load_dataset(tmp_path)
    assert "\n" not in str(caught.value)
