"""What a mask leaves out of an image is not learnt from, nor is it counted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import posed_images as made

from fieldpose.deploy.cameras import fit_cameras
from fieldpose.errors import DatasetError
from fieldpose.stages.nerf.blocks import Blocks, View
from fieldpose.stages.nerf.config import FieldConfig, TrainingConfig
from fieldpose.stages.nerf.datasets import load_dataset
from fieldpose.stages.nerf.field import Field, new_net
from fieldpose.stages.nerf.from_dataset import metadata_of, train_field, views_of
from fieldpose.stages.nerf.metadata import FieldMetadata, Space
from fieldpose.stages.nerf.raybank import RayBank, nearest_before
from fieldpose.stages.nerf.renderer import NumbaRenderer
from fieldpose.stages.nerf.training import evaluate

CAMERA = made.centred(21, 18, 25.0)
SPACE = Space(False, (0.0, 0.0, 0.0), 1.3, step=2 / 96)
SMALL = FieldConfig(levels=2, log2_table=8, hidden=8, colour_hidden=8, occupancy_resolution=8)


def masked_views() -> list[View]:
    """Blue where they are to be learnt from, red elsewhere; one has nothing to learn from, one no mask."""
    rng, views = np.random.default_rng(0), []
    for i, pose in enumerate(made.poses_around(5)):
        learnt = rng.random((18, 21)) < (0.0 if i == 2 else 0.3)
        image = np.where(learnt[..., None], (0, 0, 255), (255, 0, 0)).astype(np.uint8)
        whole = np.full((18, 21, 3), (0, 0, 255), np.uint8)
        views.append(View(f"{i}", image if i else whole, CAMERA, pose, learnt=learnt if i else None))
    return views


def test_masked_pixels_are_never_drawn() -> None:
    bank, views = RayBank(masked_views(), SPACE), masked_views()
    rng = np.random.default_rng(1)
    seen = np.zeros(5, bool)
    for _ in range(20):
        batch = bank.draw(rng, 500)
        np.testing.assert_array_equal(batch.target, np.tile(np.float32([0, 0, 1]), (500, 1)))
        centres = np.stack([-v.cam_from_object[:3, :3].T @ v.cam_from_object[:3, 3] for v in views]) / SPACE.scale
        seen |= (np.abs(batch.origins[:, None] - centres[None]).max(axis=2) < 1e-5).any(axis=0)
    assert seen.tolist() == [True, True, False, True, True]


@given(st.lists(st.booleans(), max_size=40))
def test_the_nearest_before_is_good(flags: list[bool]) -> None:
    good = np.array(flags, bool)
    found = nearest_before(good)
    assert len(found) == len(good)
    if good.any():
        assert good[found].all()
        np.testing.assert_array_equal(found[good], np.flatnonzero(good))
        assert (np.diff(found) >= 0).all()


def test_masked_pixels_are_not_counted() -> None:
    views = masked_views()
    metadata = FieldMetadata(SPACE, SMALL, (0.0, 0.0, 0.0), [], "test", "")
    field = Field(metadata, new_net(SMALL, np.random.default_rng(0)), np.zeros((8, 8, 8), bool))
    renderer = NumbaRenderer(field)
    blue = [view for view in views if view.name != "2"]
    assert evaluate(renderer, views) == pytest.approx(evaluate(renderer, blue))
    assert len(evaluate(renderer, views)) == 4
    same = [replace(view, image=np.full_like(view.image, (0, 0, 255)), learnt=None) for view in blue]
    assert evaluate(renderer, blue) == pytest.approx(evaluate(renderer, same), abs=1e-6)
    assert evaluate(renderer, blue, 3) == pytest.approx(evaluate(renderer, same, 3), abs=1e-6)


@pytest.mark.parametrize("brightest", [1, 255])
def test_mask_path_says_what_is_learnt_from_and_mask_file_path_what_is_true(tmp_path: Path, brightest: int) -> None:
    made.write_transforms(tmp_path, made.centred(48, 32, 60.0))
    left = np.zeros((32, 48), np.uint8)
    left[:, :20] = brightest
    made.save(tmp_path / "masks/0.png", left)
    made.save(tmp_path / "masks/none.png", np.zeros_like(left))
    made.save(tmp_path / "truth/0.png", brightest - left)
    file = tmp_path / "transforms.json"
    made.edit_frame(file, 0, mask_path="masks/0.png", mask_file_path="truth/0.png")
    dataset = load_dataset(tmp_path, "all")
    learnt = dataset.load_learnt(0)
    assert learnt is not None
    assert learnt.sum() == 20 * 32
    assert dataset.load_learnt(1) is None
    np.testing.assert_array_equal(dataset.load_mask(0), ~learnt)
    views = views_of(dataset.resized(24))
    assert views[0].learnt is not None
    assert views[0].learnt.shape == views[0].image.shape[:2] == (16, 24)
    assert views[1].learnt is None
    assert metadata_of(dataset, views, SMALL).space.contracted
    assert fit_cameras(dataset, "auto", 1).fit.verdict == "too few"
    for i in range(7):
        made.edit_frame(file, i, mask_path="masks/none.png")
    with pytest.raises(DatasetError, match="leave nothing to learn from"):
        train_field(tmp_path, tmp_path / "field.safetensors", None, "auto", TrainingConfig(steps=1), SMALL)


def test_views_that_mask_a_place_say_nothing_of_what_is_missing_there() -> None:
    views = masked_views()
    blocks = Blocks(views, SPACE)
    blocks.learnt(np.arange(blocks.count), np.full(blocks.count, 0.5, np.float32), np.full(blocks.count, 2, np.float32))
    wrong = blocks.wrong(0.1, np.arange(5))
    assert wrong[0].depth is not None
    assert wrong[2].depth is not None
    assert (wrong[0].depth > 1).all()
    assert (wrong[2].depth < 1e-3).all()
    assert (wrong[2].depth > 0).all()
