"""Models that COLMAP writes give the cameras that were put into them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image
from support import posed_images as made

from fieldpose.errors import DatasetError
from fieldpose.stages.geometry import Camera
from fieldpose.stages.nerf.datasets import load_dataset

LENSES: dict[str, tuple[Camera, list[float]]] = {
    "SIMPLE_PINHOLE": (Camera(96, 64, 110.0, 110.0, 46.0, 33.5), [110.0, 46.5, 34.0]),
    "PINHOLE": (Camera(96, 64, 110.0, 108.0, 46.0, 33.5), [110.0, 108.0, 46.5, 34.0]),
    "SIMPLE_RADIAL": (Camera(96, 64, 110.0, 110.0, 46.0, 33.5, (0.05, 0, 0, 0, 0)), [110.0, 46.5, 34.0, 0.05]),
    "RADIAL": (Camera(96, 64, 110.0, 110.0, 46.0, 33.5, (0.05, -0.02, 0, 0, 0)), [110.0, 46.5, 34.0, 0.05, -0.02]),
    "OPENCV": (
        Camera(96, 64, 110.0, 108.0, 46.0, 33.5, (0.05, -0.02, 0.003, -0.002, 0)),
        [110.0, 108.0, 46.5, 34.0, 0.05, -0.02, 0.003, -0.002],
    ),
    "FULL_OPENCV": (
        Camera(96, 64, 110.0, 108.0, 46.0, 33.5, (0.05, -0.02, 0.003, -0.002, 0.01)),
        [110.0, 108.0, 46.5, 34.0, 0.05, -0.02, 0.003, -0.002, 0.01, 0, 0, 0],
    ),
}


def write(
    root: Path, model: str, params: list[float], folder: str = "sparse/0", text: bool = False
) -> list[np.ndarray]:
    """Nine images of one camera, the last without a pose; returns the poses."""
    scene = pycolmap.Reconstruction()
    scene.add_camera_with_trivial_rig(pycolmap.Camera(model=model, width=96, height=64, params=params, camera_id=1))
    poses = made.poses_around(8)
    for i, pose in enumerate(poses):
        made.save(root / f"images/{i:03d}.png", made.picture(made.CAMERA, pose))
        image = pycolmap.Image(name=f"{i:03d}.png", camera_id=1, image_id=20 - i)
        scene.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose[:3]))
    target = root / folder
    target.mkdir(parents=True)
    (scene.write_text if text else scene.write_binary)(target)
    return poses


@pytest.mark.parametrize("model", list(LENSES))
@pytest.mark.parametrize("text", [False, True])
def test_cameras_and_poses_are_read(tmp_path: Path, model: str, text: bool) -> None:
    camera, params = LENSES[model]
    poses = write(tmp_path, model, params, text=text)
    dataset = load_dataset(tmp_path, "all")
    assert dataset.kind == "colmap"
    assert [record.name for record in dataset.images] == [f"images/{i:03d}.png" for i in range(8)]
    for record, pose in zip(dataset.images, poses, strict=True):
        np.testing.assert_allclose(record.cam_from_object, pose, atol=1e-9)
        assert record.camera == camera
    assert len(load_dataset(tmp_path, "test")) == 1


@pytest.mark.parametrize("folder", ["sparse/0", "sparse", "colmap/sparse/0", "colmap"])
def test_models_are_found_where_tools_leave_them(tmp_path: Path, folder: str) -> None:
    write(tmp_path, "PINHOLE", LENSES["PINHOLE"][1], folder)
    assert len(load_dataset(tmp_path, "all")) == 8


def test_images_that_were_shrunk_have_their_camera_shrunk(tmp_path: Path) -> None:
    write(tmp_path, "PINHOLE", LENSES["PINHOLE"][1])
    for path in (tmp_path / "images").iterdir():
        with Image.open(path) as image:
            small = image.resize((48, 32))
        small.save(path)
    assert load_dataset(tmp_path, "all").images[0].camera == LENSES["PINHOLE"][0].resized(48, 32)
    with Image.open(tmp_path / "images/003.png") as image:
        square = image.resize((40, 40))
    square.save(tmp_path / "images/003.png")
    with pytest.raises(DatasetError, match=r"003\.png: the image has 40x40 pixels, its camera 96x64, another shape"):
        load_dataset(tmp_path)


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("OPENCV_FISHEYE", [110.0, 108.0, 46.5, 34.0, 0.1, 0, 0, 0]),
        ("FULL_OPENCV", [110.0, 108.0, 46.5, 34.0, 0, 0, 0, 0, 0, 0.1, 0, 0]),
        ("FOV", [110.0, 108.0, 46.5, 34.0, 0.5]),
    ],
)
def test_other_lenses_are_refused_by_name(tmp_path: Path, model: str, params: list[float]) -> None:
    write(tmp_path, model, params)
    with pytest.raises(DatasetError, match=f"model {model}, .*image_undistorter"):
        load_dataset(tmp_path)


def test_what_is_missing_or_damaged_is_told(tmp_path: Path) -> None:
    write(tmp_path, "PINHOLE", LENSES["PINHOLE"][1])
    (tmp_path / "images/005.png").unlink()
    with pytest.raises(DatasetError, match=r"no image 005\.png, but .*sparse/0 lists it"):
        load_dataset(tmp_path)
    model = tmp_path / "sparse/0/images.bin"
    whole = model.read_bytes()
    model.write_bytes(whole.replace(b"005.png", b"0" * 300 + b".png"))
    with pytest.raises(DatasetError, match=r"no image 0{300}\.png, but"):
        load_dataset(tmp_path)
    model.write_bytes(whole[:40])
    with pytest.raises(DatasetError, match="no COLMAP model that can be read"):
        load_dataset(tmp_path)


def test_a_file_stands_for_one_image_and_neighbouring_models_are_named(tmp_path: Path) -> None:
    write(tmp_path, "PINHOLE", LENSES["PINHOLE"][1])
    (tmp_path / "sparse/1").mkdir()
    (note,) = load_dataset(tmp_path, "all").notes
    assert note.endswith("its neighbours are not: 1")
    model = pycolmap.Reconstruction(tmp_path / "sparse/0")
    model.images[20].name, model.images[19].name = "cam1/000.png", "cam2/000.png"
    model.write_binary(tmp_path / "sparse/0")
    with pytest.raises(DatasetError, match=r"images/000\.png is listed twice"):
        load_dataset(tmp_path)


def test_a_lens_that_folds_the_corners_is_refused(tmp_path: Path) -> None:
    write(tmp_path, "SIMPLE_RADIAL", [50.0, 46.5, 34.0, -0.5])
    with pytest.raises(DatasetError, match=r"sparse/0: .*inverse"):
        load_dataset(tmp_path)
