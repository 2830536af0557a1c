"""What phones record with ARKit's poses: Record3D's exports and Polycam's raw data."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import posed_images as made
from support import recorded

from fieldpose.errors import DatasetError
from fieldpose.stages.geometry import Camera
from fieldpose.stages.nerf.datasets import load_dataset

CAMERA = Camera(32, 24, 30.0, 28.0, 15.0, 12.5)
PORTRAIT = Camera(24, 32, 30.0, 30.0, 12.5, 15.0)


@pytest.mark.parametrize("camera", [CAMERA, PORTRAIT])
@pytest.mark.parametrize("each", [False, True])
@pytest.mark.parametrize("images", ["rgb", "EXR_RGBD/rgb", "rgbd"])
def test_record3d(tmp_path: Path, camera: Camera, each: bool, images: str) -> None:
    poses = recorded.write_record3d(tmp_path, camera, 12, each, images)
    dataset = load_dataset(tmp_path, "all")
    assert (dataset.kind, dataset.unit, dataset.metres_per_unit) == ("record3d", "m", 1.0)
    made.assert_poses(dataset, poses[:-1], 1e-9)
    assert [record.name for record in dataset.images] == [f"{images}/{i}.png" for i in range(11)]
    assert dataset.images[3].camera == (recorded.shifted(camera, 3) if each else camera)
    assert made.worst_dot_px(dataset) < 0.1
    assert dataset.notes == ("1 of 12 images is left out (no image): 11",)
    assert [i for i, record in enumerate(dataset.images) if record.split == "test"] == [0, 8]


def test_record3d_of_an_unpacked_file_and_of_one_that_is_not(tmp_path: Path) -> None:
    recorded.write_record3d(tmp_path / "a", CAMERA, images="rgbd")
    (tmp_path / "a/metadata.json").rename(tmp_path / "a/metadata")
    (tmp_path / "a/depth").mkdir()
    dataset = load_dataset(tmp_path / "a", "all")
    assert len(dataset) == 8
    assert dataset.notes[1:] == ("depth, which is EXR, is not read",)
    packed = tmp_path / "b/mine.r3d"
    recorded.text(packed, "PK")
    for path in (packed, packed.parent):
        with pytest.raises(DatasetError, match=r"mine\.r3d: a recording of Record3D that is not unpacked; unpack it"):
            load_dataset(path)


def test_record3d_images_may_be_smaller_than_said_but_of_no_other_shape(tmp_path: Path) -> None:
    recorded.write_record3d(tmp_path, CAMERA)
    file = tmp_path / "metadata.json"
    k = [60.0, 0, 0, 0, 56.0, 0, 31.0, 26.0, 1]
    made.edit_json(file, w=64, h=48, K=k)
    dataset = load_dataset(tmp_path)
    assert dataset.images[0].camera == CAMERA
    assert made.worst_dot_px(dataset) < 0.1
    made.edit_json(file, w=48, h=64)
    with pytest.raises(DatasetError, match=r"0\.png: the image has 32x24 pixels, its camera 48x64, another shape"):
        load_dataset(tmp_path)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"poses": [[0, 0, 0, 1, 0, 0, 0]] * 5}, r"metadata\.json: it has 5 poses, none for 5\.png"),
        ({"poses": [[0, 0, 0, 1, 0, 0]] * 9}, r"image 0: its pose must be 7 finite numbers"),
        ({"poses": [[0, 0, 0, 3, 0, 0, 0]] * 9}, r"image 0: the quaternion has length 3, not 1"),
        ({"poses": [[0, 0, 0, float("nan"), 0, 0, 0]] * 9}, r"image 0: its pose must be 7 finite numbers"),
        ({"K": [30.0, 0, 15.5, 0, 28.0, 13.0, 0, 0, 1]}, r"image 0: K must be fx 0 0 0 fy 0 cx cy 1"),
        ({"K": None}, r"image 0: K must be 9 finite numbers, got None"),
        ({"w": "wide"}, r"metadata\.json: not as expected .*`\$\.w`"),
        ({"perFrameIntrinsicCoeffs": [[1, 1, 1, 1]]}, r"1 perFrameIntrinsicCoeffs but 9 poses"),
        ({"perFrameIntrinsicCoeffs": [[-1, 1, 1, 1]] * 9}, r"image 0: a camera needs .* positive focal"),
    ],
)
def test_record3d_what_is_wrong_is_named(tmp_path: Path, changes: dict[str, Any], said: str) -> None:
    recorded.write_record3d(tmp_path, CAMERA)
    made.edit_json(tmp_path / "metadata.json", **changes)
    with pytest.raises(DatasetError, match=said) as caught:
        load_dataset(tmp_path)
    assert "\n" not in str(caught.value)


def test_record3d_without_images(tmp_path: Path) -> None:
    recorded.write_record3d(tmp_path, CAMERA)
    for path in (tmp_path / "rgb").iterdir():
        path.unlink()
    with pytest.raises(DatasetError, match=r"no images like rgb/0\.jpg; export the recording as EXR"):
        load_dataset(tmp_path)


@pytest.mark.parametrize("corrected", [True, False])
def test_polycam(tmp_path: Path, corrected: bool) -> None:
    poses = recorded.write_polycam(tmp_path, CAMERA, corrected=corrected)
    dataset = load_dataset(tmp_path, "all")
    assert (dataset.kind, dataset.unit, dataset.metres_per_unit) == ("polycam", "m", 1.0)
    made.assert_poses(dataset, poses, 1e-9)
    folder = "corrected_images" if corrected else "images"
    assert [record.name for record in dataset.images[:2]] == [f"keyframes/{folder}/{n}.png" for n in (1000, 1007)]
    assert dataset.images[4].camera == recorded.shifted(CAMERA, 4)
    assert made.worst_dot_px(dataset) < 0.1
    np.testing.assert_allclose(dataset.load_depth(2), np.full((24, 32), 1.252), rtol=1e-6)
    (note,) = dataset.notes
    assert note.startswith("corrected images are read" if corrected else "images are read as they were taken")


def test_polycam_up_is_z(tmp_path: Path) -> None:
    """A camera that ARKit has 1.5 m above its origin is that high here."""
    recorded.write_polycam(tmp_path, CAMERA, 1)
    file = tmp_path / "keyframes/corrected_cameras/1000.json"
    rows = {"t_00": 1, "t_01": 0, "t_02": 0, "t_10": 0, "t_11": 1, "t_12": 0, "t_20": 0, "t_21": 0, "t_22": 1}
    made.edit_json(file, **rows, t_03=0.25, t_13=1.5, t_23=-3.0)
    (record,) = load_dataset(tmp_path, holdout=None).images
    object_from_cam = np.linalg.inv(record.cam_from_object)
    np.testing.assert_allclose(object_from_cam[:3, 3], (-3.0, 0.25, 1.5), atol=1e-12)
    np.testing.assert_allclose(object_from_cam[:3, 1], (0, 0, -1), atol=1e-12)


def test_polycam_images_without_a_camera_are_left_out(tmp_path: Path) -> None:
    recorded.write_polycam(tmp_path, CAMERA)
    for name in ("1007", "1014"):
        (tmp_path / f"keyframes/corrected_cameras/{name}.json").unlink()
    dataset = load_dataset(tmp_path, "all")
    assert len(dataset) == 7
    assert dataset.notes[0] == (
        "2 of 9 images are left out (not in corrected_cameras): keyframes/corrected_images/1007.png,"
        " keyframes/corrected_images/1014.png"
    )


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"t_00": 5}, r"corrected_cameras/1000\.json: the pose is not rigid"),
        ({"t_03": float("inf")}, r"1000\.json: the pose has a number that is not finite"),
        ({"fx": 0}, r"1000\.json: a camera needs .* positive focal lengths"),
        ({"width": 24}, r"1000\.png: the image has 32x24 pixels, its camera 24x24, another shape"),
        ({"t_23": None}, r"1000\.json: not as expected .*t_23"),
    ],
)
def test_polycam_what_is_wrong_is_named(tmp_path: Path, changes: dict[str, Any], said: str) -> None:
    recorded.write_polycam(tmp_path, CAMERA)
    made.edit_json(tmp_path / "keyframes/corrected_cameras/1000.json", **changes)
    with pytest.raises(DatasetError, match=said) as caught:
        load_dataset(tmp_path)
    assert "\n" not in str(caught.value)


def test_polycam_without_images_or_with_a_key_that_is_missing(tmp_path: Path) -> None:
    recorded.write_polycam(tmp_path, CAMERA, corrected=False)
    file = tmp_path / "keyframes/cameras/1000.json"
    content = json.loads(file.read_text())
    del content["fy"]
    made.write_json(file, content)
    with pytest.raises(DatasetError, match=r"1000\.json: not as expected .*fy"):
        load_dataset(tmp_path)
    (tmp_path / "keyframes/images").rename(tmp_path / "keyframes/photos")
    with pytest.raises(DatasetError, match="keyframes: no images with cameras in it"):
        load_dataset(tmp_path)
