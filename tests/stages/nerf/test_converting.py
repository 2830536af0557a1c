"""Datasets that are converted are read again as they were, by this program and by COLMAP."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from support import posed_images as made
from support import recorded

from fieldpose.errors import DatasetError, OutputError
from fieldpose.stages.geometry import Camera
from fieldpose.stages.nerf.datasets import Dataset, converting, load_dataset
from fieldpose.stages.nerf.datasets.converting import Target, convert

ODD = Camera(32, 24, 30.1, 29.7, 14.9, 12.3)
LENS = Camera(32, 24, 30.1, 29.7, 14.9, 12.3, (0.08, -0.05, 0.003, -0.002, 0.01))
WITHOUT_K3 = Camera(32, 24, 30.1, 29.7, 14.9, 12.3, (0.08, -0.05, 0.003, -0.002, 0.0))


def write_colmap(root: Path) -> None:
    scene = pycolmap.Reconstruction()
    for i, camera in enumerate((ODD, WITHOUT_K3), 1):
        params = [camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5, *camera.distortion[:4]]
        scene.add_camera_with_trivial_rig(
            pycolmap.Camera(model="OPENCV", width=32, height=24, params=params, camera_id=i)
        )
    for i, pose in enumerate(made.poses_around(9)):
        name, camera = f"{'left' if i % 2 else 'right'}/{i}.png", (ODD, WITHOUT_K3)[i % 2]
        made.save(root / "images" / name, made.picture(camera, pose))
        image = pycolmap.Image(name=name, camera_id=1 + i % 2, image_id=20 - i)
        scene.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose[:3]))
    (root / "sparse/0").mkdir(parents=True)
    scene.write_binary(root / "sparse/0")


def write_several_lenses(root: Path) -> None:
    poses = made.write_transforms(root, LENS)
    for i, camera in ((1, ODD), (4, made.centred(24, 32, 33.3))):
        made.save(root / f"images/{i:04d}.png", made.picture(camera, poses[i]))
        made.edit_frame(root / "transforms.json", i, **made.intrinsics(camera))


KINDS: dict[str, Callable[[Path], object]] = {
    "blender": lambda root: made.write_blender(root, made.centred(24, 24, 30.0)),
    "llff": lambda root: made.write_llff(root, made.centred(32, 24, 31.7), factors=(1,)),
    "transforms": lambda root: made.write_transforms(root, LENS),
    "several lenses": write_several_lenses,
    "colmap": write_colmap,
    "record3d": lambda root: recorded.write_record3d(root, ODD, each=True),
}


def read(root: Path) -> Dataset:
    return load_dataset(root, "all", llff_normalise=False)


def assert_same(read_again: Dataset, dataset: Dataset) -> None:
    """Images are known again by their bytes, which the pictures of different poses do not share."""
    again = {record.path.read_bytes(): record for record in read_again.images}
    assert len(again) == len(dataset)
    for record in dataset.images:
        other = again[record.path.read_bytes()]
        np.testing.assert_allclose(other.cam_from_object, record.cam_from_object, atol=1e-9)
        one, two = record.camera, other.camera
        assert (two.width, two.height, two.distortion) == (one.width, one.height, one.distortion)
        np.testing.assert_allclose((two.fx, two.fy, two.cx, two.cy), (one.fx, one.fy, one.cx, one.cy), atol=1e-9)
    assert made.worst_dot_px(read_again) == pytest.approx(made.worst_dot_px(dataset), abs=1e-6)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("to", ["transforms", "colmap"])
def test_what_is_converted_is_read_as_it_was(tmp_path: Path, kind: str, to: Target) -> None:
    KINDS[kind](tmp_path / "in")
    dataset = read(tmp_path / "in")
    converted = convert(dataset, tmp_path / "out", to)
    again = read(tmp_path / "out")
    assert (converted.images, again.kind) == (len(dataset), to)
    assert_same(again, dataset)
    assert not (tmp_path / "out.partial").exists()
    if to == "transforms":
        splits = {record.path.read_bytes(): record.split for record in again.images}
        assert [splits[record.path.read_bytes()] for record in dataset.images] == [r.split for r in dataset.images]
        assert converted.held_out == sum(record.split == "test" for record in dataset.images)
        assert (again.metres_per_unit, again.scene) == (dataset.metres_per_unit, dataset.scene)


@pytest.mark.parametrize("kind", KINDS)
def test_colmap_reads_the_model(tmp_path: Path, kind: str) -> None:
    KINDS[kind](tmp_path / "in")
    dataset = read(tmp_path / "in")
    convert(dataset, tmp_path / "out", "colmap")
    model = pycolmap.Reconstruction(tmp_path / "out/sparse/0")
    assert model.num_reg_images() == len(dataset)
    assert model.num_points3D() == 0
    by_bytes = {record.path.read_bytes(): record for record in dataset.images}
    for image in model.images.values():
        record = by_bytes[(tmp_path / "out/images" / image.name).read_bytes()]
        np.testing.assert_allclose(image.cam_from_world().matrix(), record.cam_from_object[:3], atol=1e-9)
        seen = model.cameras[image.camera_id].img_from_cam((record.cam_from_object @ [*made.POINT, 1.0])[:3])
        np.testing.assert_allclose(seen - 0.5, made.seen_at(record.camera, record.cam_from_object), atol=1e-9)


def test_depth_masks_boxes_and_metres_are_kept(tmp_path: Path) -> None:
    made.write_transforms(tmp_path / "in", LENS)
    file = tmp_path / "in/transforms.json"
    made.edit_json(file, aabb=[[-2, -2, -1], [2, 3, 1]], object_aabb=[[-1, -1, -1], [1, 1, 1]], metres_per_unit=0.1)
    np.save(tmp_path / "in/d.npy", np.arange(768, dtype=np.float32).reshape(24, 32))
    made.save(tmp_path / "in/learnt.png", np.eye(24, 32, dtype=np.uint8))
    made.save(tmp_path / "in/true.bmp", 255 * np.eye(24, 32, 5, dtype=np.uint8))
    made.edit_frame(
        file, 2, depth_file_path="d.npy", depth_scale=0.5, mask_path="learnt.png", mask_file_path="true.bmp"
    )
    dataset = read(tmp_path / "in")
    assert not convert(dataset, tmp_path / "out", "transforms").lost
    again = read(tmp_path / "out")
    assert (again.scene, again.metres_per_unit) == ("bounded", 0.1)
    np.testing.assert_array_equal(again.bounds.aabb, dataset.bounds.aabb)
    np.testing.assert_array_equal(again.object_aabb, dataset.object_aabb)
    np.testing.assert_array_equal(again.load_depth(2), dataset.load_depth(2))
    np.testing.assert_array_equal(again.load_mask(2), dataset.load_mask(2))
    np.testing.assert_array_equal(again.load_learnt(2), dataset.load_learnt(2))
    assert again.images[0].learnt_path is None
    lost = convert(dataset, tmp_path / "colmap", "colmap").lost
    assert lost == (
        "which images are held out", "the length of the unit in metres", "boxes", "true depths and outlines",
    )  # fmt: skip
    mapped = read(tmp_path / "colmap")
    np.testing.assert_array_equal(mapped.load_learnt(2), dataset.load_learnt(2))
    assert np.all(mapped.load_learnt(0))


def test_without_a_held_out_image_none_is_held_out_again(tmp_path: Path) -> None:
    made.write_transforms(tmp_path / "in", ODD)
    convert(load_dataset(tmp_path / "in", "all", holdout=None), tmp_path / "out", "transforms")
    assert {record.split for record in read(tmp_path / "out").images} == {"train"}


def test_images_can_be_left_where_they_are(tmp_path: Path) -> None:
    made.write_transforms(tmp_path / "in", ODD)
    convert(read(tmp_path / "in"), tmp_path / "out", "transforms", images=False)
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["transforms.json"]
    (tmp_path / "out/images").symlink_to(tmp_path / "in/images")
    assert_same(read(tmp_path / "out"), read(tmp_path / "in"))


def test_names_with_spaces_are_no_names_of_colmap(tmp_path: Path) -> None:
    made.write_transforms(tmp_path / "in", ODD)
    (tmp_path / "in/images/0003.png").rename(tmp_path / "in/images/the third.png")
    made.edit_frame(tmp_path / "in/transforms.json", 3, file_path="images/the third.png")
    dataset = read(tmp_path / "in")
    with pytest.raises(DatasetError, match=r"'the third\.png': COLMAP's text cannot hold a name with a space; rename"):
        convert(dataset, tmp_path / "out", "colmap")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in"]
    convert(dataset, tmp_path / "out", "transforms")
    assert_same(read(tmp_path / "out"), dataset)


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_conversion_that_ends_early_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    made.write_transforms(tmp_path / "in", ODD)
    (tmp_path / "out").mkdir()
    copied: list[Path] = []

    def copy(path: Path, to: Path) -> None:
        if len(copied) == 3:
            raise error
        copied.append(to)

    monkeypatch.setattr(converting, "_copy", copy)
    expected = OutputError if isinstance(error, OSError) else KeyboardInterrupt
    with pytest.raises(expected) as caught:
        convert(read(tmp_path / "in"), tmp_path / "out", "transforms")
    assert isinstance(error, KeyboardInterrupt) or str(caught.value).endswith(
        "cannot be written: No space left on device"
    )
    assert len(copied) == 3
    assert not list((tmp_path / "out").iterdir())
    assert not (tmp_path / "out.partial").exists()


def test_an_unfinished_conversion_is_in_the_way(tmp_path: Path) -> None:
    made.write_transforms(tmp_path / "in", ODD)
    recorded.text(tmp_path / "out.partial/images/0.png", "")
    with pytest.raises(OutputError, match=r"out\.partial: an unfinished conversion is in the way; remove it"):
        convert(read(tmp_path / "in"), tmp_path / "out", "transforms")
    assert (tmp_path / "out.partial/images/0.png").exists()
