"""BOP's scenes: an object's poses in mm, what is learnt around it, and what is wrong."""

from __future__ import annotations

import json
from collections.abc import Callable
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
POINT = recorded.MM * made.POINT
Edit = Callable[[Any], object]


def edit(file: Path, change: Edit) -> None:
    content = json.loads(file.read_text())
    changed = change(content)
    made.write_json(file, content if changed is None else changed)


def test_an_object_of_several_is_named_by_the_path(tmp_path: Path) -> None:
    poses = recorded.write_bop(tmp_path, CAMERA)
    with pytest.raises(DatasetError, match=r"it has 2 objects \(5, 12\); name one of them .*/obj_000005"):
        load_dataset(tmp_path)
    dataset = load_dataset(tmp_path / "obj_000005", "all")
    assert (dataset.kind, dataset.unit, dataset.metres_per_unit) == ("bop", "mm", 0.001)
    made.assert_poses(dataset, poses, 1e-9)
    assert dataset.images[0].camera == CAMERA
    assert dataset.images[2].name == "rgb/000002.png"
    assert made.worst_dot_px(dataset, POINT) < 0.1
    assert [record.split for record in dataset.images] == ["test", *["train"] * 7, "test"]
    np.testing.assert_allclose(dataset.load_depth(3), 4003 * 0.5)
    assert [int(dataset.load_mask(i).sum()) for i in range(3)] == [320, 320, 320]
    other = load_dataset(tmp_path / "obj_12", "all")
    made.assert_poses(other, [pose @ np.diag([-1.0, -1, 1, 1]) for pose in poses], 1e-9)
    assert int(other.load_mask(0).sum()) == 96
    with pytest.raises(DatasetError, match=r"scene_gt\.json: it has no object 7, but 5, 12"):
        load_dataset(tmp_path / "obj_000007")
    with pytest.raises(DatasetError, match="no such folder"):
        load_dataset(tmp_path / "object_5")


def test_what_stands_still_around_an_object_is_learnt(tmp_path: Path) -> None:
    recorded.write_bop(tmp_path, CAMERA)
    dataset = load_dataset(tmp_path / "obj_000005", "all")
    assert dataset.load_learnt(0) is None
    assert dataset.notes == (
        "object 5: it stands still in its world (cam_R_w2c), so that what is around it is learnt too",
    )
    edit(tmp_path / "scene_gt.json", lambda content: content["4"][0].update(cam_t_m2c=[300.0, 0.0, 3000.0]))
    dataset = load_dataset(tmp_path / "obj_000005", "all")
    learnt = dataset.load_learnt(0)
    assert learnt is not None
    assert learnt[:10].all()
    assert not learnt[10:].any()
    assert "may move against it" in dataset.notes[0]


@pytest.mark.parametrize("world", [True, False])
def test_an_onboarding_sequence_has_one_object_which_its_masks_cut_out(tmp_path: Path, world: bool) -> None:
    root = tmp_path / "onboarding_static/obj_000005_up"
    poses = recorded.write_bop(root, CAMERA, world=world)
    recorded.one_object(root)
    dataset = load_dataset(root, "all")
    made.assert_poses(dataset, poses, 1e-9)
    learnt = dataset.load_learnt(1)
    assert learnt is not None
    assert int(learnt.sum()) == 320
    assert "as in all onboarding sequences" in dataset.notes[0]


def test_without_masks_and_without_a_world_it_is_said(tmp_path: Path) -> None:
    recorded.write_bop(tmp_path, CAMERA, world=False)
    for path in (tmp_path / "mask_visib").iterdir():
        path.unlink()
    dataset = load_dataset(tmp_path / "obj_000005", "all")
    assert dataset.load_learnt(0) is None
    assert "as if it stood still with it; there is no mask_visib" in dataset.notes[0]
    with pytest.raises(DatasetError, match="the dataset has no mask"):
        dataset.load_mask(0)
    for i in range(9):
        made.save(tmp_path / f"masks/{i:06d}.png", np.eye(24, 32, dtype=np.uint8))
    learnt = load_dataset(tmp_path / "obj_000005", "all").load_learnt(0)
    assert learnt is not None
    assert learnt.sum() == 24


def test_images_without_the_object_or_with_two_of_it_are_left_out(tmp_path: Path) -> None:
    poses = recorded.write_bop(tmp_path, CAMERA)

    def change(content: Any) -> None:
        del content["3"]
        content["5"] = [one for one in content["5"] if one["obj_id"] != recorded.OBJECT]
        content["6"].append(content["6"][0])

    edit(tmp_path / "scene_gt.json", change)
    dataset = load_dataset(tmp_path / "obj_000005", "all")
    made.assert_poses(dataset, [pose for i, pose in enumerate(poses) if i not in (3, 5, 6)], 1e-9)
    assert dataset.notes[:2] == (
        "2 of 9 images are left out (scene_gt.json has no pose of object 5): 000003, 000005",
        "1 of 9 images is left out (object 5 is there several times): 000006",
    )


def test_grey_images_are_read_where_there_are_no_others(tmp_path: Path) -> None:
    poses = recorded.write_bop(tmp_path, CAMERA)
    (tmp_path / "rgb").rename(tmp_path / "gray")
    dataset = load_dataset(tmp_path / "obj_000005", "all")
    assert dataset.images[0].name == "gray/000000.png"
    made.assert_poses(dataset, poses, 1e-9)


@pytest.mark.parametrize(
    ("file", "change", "said"),
    [
        ("scene_gt.json", lambda c: {"x": c["0"]}, r"scene_gt\.json: expected the numbers of images, got 'x'"),
        ("scene_gt.json", lambda c: {}, r"scene_gt\.json: expected the numbers of images"),
        ("scene_gt.json", lambda c: {"0": []}, r"scene_gt\.json: it has no object"),
        ("scene_gt.json", lambda c: c["0"][0].update(cam_R_m2c=[1, 0]), r"image 0: cam_R_m2c must be 9 finite numbers"),
        ("scene_gt.json", lambda c: c["0"][0].update(cam_R_m2c=[2] * 9), r"image 0: the pose is not rigid"),
        ("scene_gt.json", lambda c: c.update({"77": c["0"]}), r"scene_camera\.json: it has no image 77"),
        ("scene_gt.json", lambda c: c["0"][0].pop("cam_t_m2c"), r"scene_gt\.json: not as expected .*cam_t_m2c"),
        ("scene_camera.json", lambda c: c["0"].update(cam_K=[1] * 9), r"image 0: cam_K must be fx 0 cx 0 fy cy 0 0 1"),
        ("scene_camera.json", lambda c: c["0"]["cam_K"].__setitem__(0, -4.0), r"image 0: a camera needs .* positive"),
        ("scene_camera.json", lambda c: c["0"].update(depth_scale=0), r"image 0: depth_scale must be positive, got 0"),
        ("scene_camera.json", lambda c: c.update({"9": c["0"]}), None),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, file: str, change: Edit, said: str | None) -> None:
    recorded.write_bop(tmp_path, CAMERA)

    def whole(content: Any) -> Any:
        changed = change(content)
        return changed if isinstance(changed, dict) and "cam_K" not in changed else content

    edit(tmp_path / file, whole)
    if said is None:
        assert len(load_dataset(tmp_path / "obj_000005", "all")) == 9
        return
    with pytest.raises(DatasetError, match=said) as caught:
        load_dataset(tmp_path / "obj_000005")
    assert "\n" not in str(caught.value)


def test_missing_images_and_masks_are_named(tmp_path: Path) -> None:
    recorded.write_bop(tmp_path, CAMERA)
    (tmp_path / "rgb/000004.png").rename(tmp_path / "away.png")
    with pytest.raises(DatasetError, match=r"rgb/000004: no such image, but scene_camera\.json lists it"):
        load_dataset(tmp_path / "obj_000005")
    (tmp_path / "away.png").rename(tmp_path / "rgb/000004.png")
    (tmp_path / "mask_visib/000003_000001.png").unlink()
    with pytest.raises(DatasetError, match="mask_visib: no 000003_000001, but others are there"):
        load_dataset(tmp_path / "obj_000005")
    (tmp_path / "scene_gt.json").unlink()
    with pytest.raises(DatasetError, match=r"scene_gt\.json: no such file"):
        load_dataset(tmp_path)
