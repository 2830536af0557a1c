"""transforms.json as it is written is read again as it was."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support import posed_images as made

from fieldpose.stages.geometry import Camera
from fieldpose.stages.nerf.datasets import load_dataset
from fieldpose.stages.nerf.datasets.writing import transforms_document


def write(root: Path, cameras: list[Camera], held_out: set[str] | None) -> tuple[list[str], list[np.ndarray]]:
    poses = made.poses_around(len(cameras))
    names = [f"images/{i:03d}.png" for i in range(len(cameras))]
    (root / "images").mkdir()
    for name, camera, pose in zip(names, cameras, poses, strict=True):
        Image.fromarray(made.picture(camera, pose)).save(root / name)
    document = transforms_document(names, cameras, np.stack(poses), held_out, {"metres_per_unit": 0.25})
    (root / "transforms.json").write_text(json.dumps(document))
    return names, poses


@pytest.mark.parametrize("lenses", [[made.DISTORTED] * 6, [made.CAMERA, made.DISTORTED] * 3])
def test_what_is_written_is_read(tmp_path: Path, lenses: list[Camera]) -> None:
    names, poses = write(tmp_path, lenses, {"images/001.png", "images/004.png"})
    read = load_dataset(tmp_path, "all")
    assert [record.name for record in read.images] == names
    assert [record.split for record in read.images] == ["train", "test", "train", "train", "test", "train"]
    assert read.metres_per_unit == 0.25
    for record, camera, pose in zip(read.images, lenses, poses, strict=True):
        np.testing.assert_allclose(record.cam_from_object, pose, atol=1e-12)
        assert record.camera.distortion == camera.distortion
        np.testing.assert_allclose(
            (record.camera.fx, record.camera.fy, record.camera.cx, record.camera.cy),
            (camera.fx, camera.fy, camera.cx, camera.cy),
        )


def test_without_a_split_the_reader_splits(tmp_path: Path) -> None:
    write(tmp_path, [made.CAMERA] * 4, None)
    assert [r.split for r in load_dataset(tmp_path, "all", holdout="odd").images] == ["train", "test", "train", "test"]
