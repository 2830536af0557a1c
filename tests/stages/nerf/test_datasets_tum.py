"""TUM RGB-D: poses at the images' times, cameras by the folder's name, depth, and what is wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support import posed_images as made
from support import recorded

from fieldpose.errors import DatasetError
from fieldpose.stages.geometry import Camera
from fieldpose.stages.nerf.datasets import load_dataset
from fieldpose.stages.nerf.datasets.intrinsics import check_invertible
from fieldpose.stages.nerf.datasets.tum import CAMERAS

FREIBURG3 = CAMERAS["3"].resized(32, 24)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return tmp_path / "rgbd_dataset_freiburg3_teddy"


def drop(file: Path, *lines: int) -> None:
    kept = [line for i, line in enumerate(file.read_text().splitlines()) if i not in lines]
    recorded.text(file, "\n".join(kept))


def test_poses_are_those_at_the_images_times(root: Path) -> None:
    poses = recorded.write_tum(root, FREIBURG3)
    dataset = load_dataset(root, "all")
    assert (dataset.kind, dataset.unit, dataset.metres_per_unit) == ("tum", "m", 1.0)
    made.assert_poses(dataset, poses, 1e-5)
    assert dataset.images[0].camera == FREIBURG3
    assert dataset.images[0].name == "rgb/1305031102.195304.png"
    assert made.worst_dot_px(dataset) < 0.1
    assert [record.split for record in dataset.images] == ["test", *["train"] * 7, "test"]
    np.testing.assert_allclose(dataset.load_depth(4), 5040 / 5000, rtol=1e-6)
    assert dataset.notes == ("the camera is the one published for freiburg3, as the folder's name tells",)


def test_an_image_at_the_very_time_of_a_pose_has_that_pose(root: Path) -> None:
    recorded.write_tum(root, FREIBURG3)
    drop(root / "groundtruth.txt", *range(3, 12))
    (line,) = (root / "groundtruth.txt").read_text().splitlines()[2:]
    time, *values = line.split()
    image = (root / "rgb.txt").read_text().splitlines()[1].split()[1]
    recorded.text(root / "rgb.txt", f"{time} {image}\n")
    (record,) = load_dataset(root, holdout=None).images
    pose = np.linalg.inv(record.cam_from_object)
    np.testing.assert_allclose(pose[:3, 3], [float(v) for v in values[:3]], atol=1e-9)
    np.testing.assert_allclose(recorded.quaternion(pose), [float(v) for v in values[3:]], atol=1e-9)


def test_images_in_a_gap_or_outside_are_left_out(root: Path) -> None:
    poses = recorded.write_tum(root, FREIBURG3)
    drop(root / "groundtruth.txt", 2, 6)
    dataset = load_dataset(root, "all")
    made.assert_poses(dataset, [pose for i, pose in enumerate(poses) if i not in (0, 3, 4)], 1e-5)
    assert dataset.notes[1].startswith("3 of 9 images are left out (no poses within 0.1 s of each other are around)")
    recorded.text(root / "groundtruth.txt", "1.0 0 0 0 0 0 0 1\n")
    with pytest.raises(DatasetError, match=r"groundtruth\.txt: no image of rgb\.txt is between two of its poses"):
        load_dataset(root)


def test_depth_is_that_of_the_same_time_or_none(root: Path) -> None:
    recorded.write_tum(root, FREIBURG3)
    drop(root / "depth.txt", 3)
    dataset = load_dataset(root, "all")
    with pytest.raises(DatasetError, match="no depth for this image"):
        dataset.load_depth(2)
    np.testing.assert_allclose(dataset.load_depth(3), 5030 / 5000, rtol=1e-6)


@pytest.mark.parametrize("number", ["1", "2"])
def test_distorted_cameras_are_those_of_their_images(tmp_path: Path, number: str) -> None:
    camera = CAMERAS[number].resized(32, 24)
    root = tmp_path / f"fr{number}_desk"
    recorded.write_tum(root, camera)
    check_invertible(CAMERAS[number])
    dataset = load_dataset(root)
    assert dataset.images[0].camera == camera
    assert dataset.images[0].camera.is_distorted
    assert made.worst_dot_px(dataset) < 0.1


def test_another_camera_is_asked_for_and_taken(tmp_path: Path) -> None:
    recorded.write_tum(tmp_path / "kitchen", FREIBURG3)
    with pytest.raises(DatasetError, match=r"kitchen: its name tells no camera .*write the calibration into .*\.json"):
        load_dataset(tmp_path / "kitchen")
    camera = {"width": 32, "height": 24, "fx": 26.0, "fy": 27.0, "cx": 15.0, "cy": 12.0}
    made.write_json(tmp_path / "kitchen/camera.json", camera)
    assert load_dataset(tmp_path / "kitchen").images[0].camera == Camera(**camera)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("file", "content", "said"),
    [
        ("groundtruth.txt", "1 2 3\n", r"groundtruth\.txt: line 1: expected a time, x, y, z and a quaternion"),
        ("groundtruth.txt", "# nothing\n", r"groundtruth\.txt: it is empty; expected lines of a time, x, y, z"),
        ("groundtruth.txt", "1 0 0 0 0 0 0 0\n", r"line 1: the quaternion has length 0, not 1"),
        ("groundtruth.txt", "1 0 0 nan 0 0 0 1\n", r"line 1: the pose has a number that is not finite"),
        ("groundtruth.txt", "1 0 0 x 0 0 0 1\n", r"line 1: could not convert string to float"),
        ("groundtruth.txt", "nan 0 0 0 0 0 0 1\n", r"line 1: the time nan is not finite"),
        ("rgb.txt", "1.0 rgb/none.png\n", r"rgb\.txt: line 1: no image rgb/none\.png in"),
        ("rgb.txt", "rgb/none.png\n", r"rgb\.txt: line 1: expected a time and a path"),
        ("depth.txt", "1.0 depth/none.png\n", r"depth\.txt: line 1: no image depth/none\.png in"),
    ],
)
def test_what_is_wrong_is_named(root: Path, file: str, content: str, said: str) -> None:
    recorded.write_tum(root, FREIBURG3)
    recorded.text(root / file, content)
    with pytest.raises(DatasetError, match=said) as caught:
        load_dataset(root)
    assert "\n" not in str(caught.value)


def test_a_sequence_without_poses_and_an_image_that_is_listed_twice(root: Path) -> None:
    recorded.write_tum(root, FREIBURG3)
    lines = (root / "rgb.txt").read_text().splitlines()
    recorded.text(root / "rgb.txt", "\n".join([*lines, lines[2]]))
    with pytest.raises(DatasetError, match=r"rgb/.*\.png is listed twice"):
        load_dataset(root)
    (root / "groundtruth.txt").unlink()
    with pytest.raises(DatasetError, match=r"groundtruth\.txt: no such file"):
        load_dataset(root)
