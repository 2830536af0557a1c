"""Masks in a folder beside the images, for datasets of all kinds whose files name none."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support import posed_images as made
from support import recorded

from fieldpose.errors import DatasetError
from fieldpose.stages.geometry import Camera
from fieldpose.stages.nerf.datasets import load_dataset
from fieldpose.stages.nerf.datasets.tum import CAMERAS

CAMERA = made.centred(32, 24, 30.0)
FREIBURG3 = CAMERAS["3"].resized(32, 24)
Write = Callable[[Path], object]
KINDS: dict[str, tuple[Write, str, Callable[[str], str]]] = {
    "transforms": (lambda r: made.write_transforms(r, CAMERA), "masks", lambda name: name.removeprefix("images/")),
    "colmap's names": (lambda r: made.write_transforms(r, CAMERA), "masks", lambda name: name[7:] + ".png"),
    "whole paths": (lambda r: made.write_transforms(r, CAMERA), "masks", lambda name: name),
    "llff": (lambda r: made.write_llff(r, CAMERA, factors=(1,)), "masks", lambda name: name.removeprefix("images/")),
    "sequence": (lambda r: recorded.write_seven_scenes(r, CAMERA), "masks", lambda name: name),
    "tum": (lambda r: recorded.write_tum(r, FREIBURG3), "masks", lambda name: name.removeprefix("rgb/")),
    "record3d": (
        lambda r: recorded.write_record3d(r, CAMERA, images="EXR_RGBD/rgb"),
        "EXR_RGBD/masks",
        lambda name: name.removeprefix("EXR_RGBD/rgb/"),
    ),
    "polycam": (
        lambda r: recorded.write_polycam(r, CAMERA),
        "keyframes/masks",
        lambda name: name.removeprefix("keyframes/corrected_images/"),
    ),
}


def mask(index: int, width: int = 32, height: int = 24) -> np.ndarray:
    """Learnt in so many columns from the left."""
    pixels = np.zeros((height, width), np.uint8)
    pixels[:, : index + 1] = 255
    return pixels


@pytest.mark.parametrize("kind", KINDS)
def test_masks_say_what_is_learnt(tmp_path: Path, kind: str) -> None:
    write, folder, name_of = KINDS[kind]
    root = tmp_path / "freiburg3"
    write(root)
    names = [record.name for record in load_dataset(root, "all").images]
    for i, name in enumerate(names):
        made.save(root / folder / name_of(name), mask(i))
    dataset = load_dataset(root, "all")
    for i in range(len(names)):
        learnt = dataset.load_learnt(i)
        assert learnt is not None
        np.testing.assert_array_equal(learnt, mask(i) > 0)
    assert dataset.notes[-1] == f"masks of {root / folder} say what is learnt: white is, black is not"
    (root / folder / name_of(names[3])).unlink()
    with pytest.raises(DatasetError, match=rf"masks: 1 of {len(names)} images have no mask there: {names[3]}; add"):
        load_dataset(root)


def test_extensions_may_differ_and_sizes_but_not_shapes(tmp_path: Path) -> None:
    made.write_transforms(tmp_path, CAMERA)
    for i in range(7):
        made.save(tmp_path / f"masks/{i:04d}.bmp", np.kron(mask(i), np.ones((2, 2), np.uint8)))
    (tmp_path / "masks/0004.bmp").rename(tmp_path / "masks/0004.BMP")
    learnt = load_dataset(tmp_path, "all").load_learnt(4)
    assert learnt is not None
    np.testing.assert_array_equal(learnt, mask(4) > 0)
    made.save(tmp_path / "masks/0002.bmp", mask(2, 32, 32))
    with pytest.raises(
        DatasetError, match=r"0002\.bmp: the mask has 32x32 pixels, images/0002\.png 32x24, another shape"
    ):
        load_dataset(tmp_path)


def test_one_mask_is_of_one_image(tmp_path: Path) -> None:
    camera = Camera(640, 480, 525.0, 525.0, 319.5, 239.5).resized(32, 24)
    for sequence in ("seq-01", "seq-02"):
        recorded.write_seven_scenes(tmp_path / sequence, camera, 3)
    for i in range(3):
        made.save(tmp_path / f"masks/frame-{i:06d}.color.png", mask(i))
    with pytest.raises(DatasetError, match=r"000000\.color\.png: it is the mask of seq-01/.* and of seq-02/frame-0"):
        load_dataset(tmp_path)
    for i in range(3):
        for sequence in ("seq-01", "seq-02"):
            made.save(tmp_path / f"masks/{sequence}/frame-{i:06d}.color.png", mask(i))
    assert load_dataset(tmp_path, "all").images[3].learnt_path == tmp_path / "masks/seq-02/frame-000000.color.png"


def test_files_that_name_masks_are_believed(tmp_path: Path) -> None:
    made.write_transforms(tmp_path, CAMERA)
    made.save(tmp_path / "masks/0000.png", mask(5))
    made.edit_frame(tmp_path / "transforms.json", 0, mask_file_path="masks/0000.png")
    dataset = load_dataset(tmp_path, "all")
    assert dataset.load_learnt(0) is None
    assert dataset.load_mask(0).sum() == 6 * 24
    made.edit_frame(tmp_path / "transforms.json", 0, mask_file_path=None)
    with pytest.raises(DatasetError, match=r"masks: 6 of 7 images have no mask there: images/0001\.png"):
        load_dataset(tmp_path)
