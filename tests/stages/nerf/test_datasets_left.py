"""Datasets as other programs and other machines leave them, which are read all the same."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from support import posed_images as made

from fieldpose.errors import DatasetError
from fieldpose.stages.camera.config import CameraConfig
from fieldpose.stages.camera.sources import open_source
from fieldpose.stages.nerf.datasets import load_dataset

CAMERA = made.centred(48, 48, 60.0)


def names(root: Path) -> list[str]:
    return [record.name for record in load_dataset(root, "all").images]


def test_a_byte_order_mark_is_no_content(tmp_path: Path) -> None:
    made.write_transforms(tmp_path, CAMERA)
    file = tmp_path / "transforms.json"
    file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())
    assert len(load_dataset(tmp_path, "all")) == 7


def test_extensions_may_differ_in_case(tmp_path: Path) -> None:
    made.write_blender(tmp_path, CAMERA)
    before = names(tmp_path)
    (tmp_path / "train" / "r_0.png").rename(tmp_path / "train" / "r_0.PNG")
    assert names(tmp_path) == ["train/r_0.PNG", *before[1:]]


@pytest.mark.parametrize("prefix", ["data/mine/", "./", "../somewhere/", "C:\\work\\mine\\"])
def test_paths_may_begin_where_the_converter_ran(tmp_path: Path, prefix: str) -> None:
    made.write_transforms(tmp_path, CAMERA)
    before, file = names(tmp_path), tmp_path / "transforms.json"
    content = json.loads(file.read_text())
    for frame in content["frames"]:
        frame["file_path"] = prefix + frame["file_path"]
    made.write_json(file, content)
    assert names(tmp_path) == before


def test_absolute_paths_and_a_split(tmp_path: Path) -> None:
    made.write_transforms(tmp_path, CAMERA)
    file = tmp_path / "transforms.json"
    content = json.loads(file.read_text())
    for frame in content["frames"]:
        frame["file_path"] = str(tmp_path / frame["file_path"])
    listed = [frame["file_path"] for frame in content["frames"]]
    made.write_json(file, content | {"train_filenames": listed[:5], "test_filenames": listed[5:]})
    dataset = load_dataset(tmp_path, "all")
    assert [r.name for r in dataset.images] == [f"images/{i:04d}.png" for i in range(7)]
    assert [r.split for r in dataset.images] == ["train"] * 5 + ["test"] * 2


def test_keys_of_other_programs_are_theirs(tmp_path: Path) -> None:
    made.write_transforms(tmp_path, CAMERA)
    file = tmp_path / "transforms.json"
    theirs = {
        "applied_transform": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], "applied_scale": 2.0, "aabb_scale": 16,
        "scale": 0.5, "offset": [0, 0, 0], "ply_file_path": "sparse_pc.ply", "k5": 0,
        "orientation_override": "none", "n_extra_learnable_dims": 0, "from_na": False, "fix_premult": True,
        "fisheye_crop_radius": 900, "panoptic_classes": "p.json",
    }  # fmt: skip
    made.edit_json(file, **theirs)
    made.edit_frame(file, 0, colmap_im_id=3, sharpness=12.0, normal_file_path="n.png", camera_id=1, camera_label="a")
    made.edit_json(file, n_frames=7)
    dataset = load_dataset(tmp_path, "all")
    assert not dataset.notes
    # The poses are those after what was applied to them.
    made.assert_poses(dataset, made.poses_around(7))


def test_depth_without_a_scale_matters_only_where_depth_is_asked_for(tmp_path: Path) -> None:
    made.write_blender(tmp_path, CAMERA)
    np.save(tmp_path / "depth.npy", np.ones((48, 48), np.float32))
    made.edit_frame(tmp_path / "transforms_train.json", 0, depth_file_path="depth.npy")
    dataset = load_dataset(tmp_path)
    with pytest.raises(DatasetError, match=r"depth\.npy: the dataset has no depth_scale"):
        dataset.load_depth(0)


def test_a_test_file_that_repeats_the_training_file_is_named(tmp_path: Path) -> None:
    made.write_blender(tmp_path, CAMERA)
    (tmp_path / "transforms_test.json").write_bytes((tmp_path / "transforms_train.json").read_bytes())
    with pytest.raises(
        DatasetError, match=r"transforms_train\.json and transforms_test\.json: train/r_0\.png is listed"
    ):
        load_dataset(tmp_path)


def test_a_scene_far_from_its_origin_is_refused_with_what_to_subtract(tmp_path: Path) -> None:
    made.write_transforms(tmp_path, CAMERA)
    file = tmp_path / "transforms.json"
    for offset, far in ((100.0, False), (450_000.0, True)):
        content = json.loads(file.read_text())
        for frame in content["frames"]:
            frame["transform_matrix"][0][3] += offset
        made.write_json(file, content)
        if far:
            with pytest.raises(DatasetError, match=r"around \(450\d\d\d, .*good to 0\.031 only.*subtract"):
                load_dataset(tmp_path)
        else:
            assert len(load_dataset(tmp_path, "all")) == 7


def test_hidden_files_are_no_images(tmp_path: Path) -> None:
    made.write_llff(tmp_path, made.centred(96, 64, 80.0))
    for folder in ("images", "images_4"):
        (tmp_path / folder / "._image000.png").write_bytes(b"\0\5\x16\7")
    assert len(load_dataset(tmp_path, "all")) == 10
    source = open_source(CameraConfig(source=f"folder:{tmp_path / 'images'}"))
    assert source.length == 10
