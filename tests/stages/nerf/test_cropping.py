"""A field of an object alone: within the box what the whole shows, outside nothing."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from fieldpose.deploy.scene import demo_file
from fieldpose.errors import ConfigError
from fieldpose.stages.geometry import Similarity, points_at_depth, rotation_about
from fieldpose.stages.nerf.cropping import cropped
from fieldpose.stages.nerf.datasets import load_dataset
from fieldpose.stages.nerf.field import Field, load_field
from fieldpose.stages.nerf.framing import reframed
from fieldpose.stages.nerf.metadata import PoseAccuracy
from fieldpose.stages.nerf.renderer import NumbaRenderer
from fieldpose.stages.nerf.training_views import training_views


@pytest.fixture(scope="module")
def demo() -> Field:
    return load_field(demo_file("field.safetensors"))


@pytest.fixture(scope="module")
def box() -> np.ndarray:
    named = load_dataset(demo_file("transforms_test.json").parent, "test").object_aabb
    assert named is not None
    return named


@pytest.mark.parametrize("moved", [False, True])
def test_within_the_box_it_is_the_same_and_outside_nothing_is(demo: Field, box: np.ndarray, moved: bool) -> None:
    whole = demo
    if moved:
        by = Similarity(0.5, rotation_about(np.array([0.0, 0.0, 1.0]), np.pi / 2)[:3, :3], np.array([1.0, 2.0, 3.0]))
        whole = Field(reframed(demo.metadata, by), demo.net, demo.occupied)
        box = np.sort(by.of_points(box), axis=0)
    alone = cropped(whole, box)
    shares = []
    for view in whole.metadata.cameras[::20]:
        camera = view.camera.undistorted().shrunk(120)
        all_of_it = NumbaRenderer(whole).render_view(camera, view.pose)
        part = NumbaRenderer(alone).render_view(camera, view.pose)
        solid = (part.opacity > 0.5).ravel()
        points = points_at_depth(camera, view.pose, camera.grid(), all_of_it.depth.ravel())
        slack = 0.02 * (box[1] - box[0]).max()
        inside = ((points > box[0] + slack) & (points < box[1] - slack)).all(axis=1)
        outside = ((points < box[0] - slack) | (points > box[1] + slack)).any(axis=1)
        behind = all_of_it.depth.ravel() > part.depth.ravel() * 1.02
        assert (solid & inside).sum() > 0.97 * inside.sum()
        assert (solid & outside & ~behind).mean() < 0.01
        both = solid & inside
        np.testing.assert_allclose(np.median(np.abs(part.depth.ravel() - all_of_it.depth.ravel())[both]), 0, atol=0.01)
        assert (
            np.abs(part.rgb.reshape(-1, 3)[both].astype(int) - all_of_it.rgb.reshape(-1, 3)[both]) <= 8
        ).mean() > 0.9
        shares.append(both.mean())
    assert max(shares) > 0.15


def test_a_part_can_be_saved_and_cut_again(demo: Field, box: np.ndarray, tmp_path: Path) -> None:
    tried = msgspec.structs.replace(demo.metadata, accuracy=PoseAccuracy(9, 9, 0.1, 0.01, error_scale=1.5))
    alone = cropped(Field(tried, demo.net, demo.occupied), box)
    assert (alone.metadata.has_background, alone.metadata.accuracy, alone.metadata.psnr_db) == (False, None, None)
    assert training_views(alone).error_scale == alone.metadata.error_scale == 1.5
    assert alone.occupied.sum() < 0.2 * demo.occupied.sum()
    path = tmp_path / "alone.safetensors"
    alone.save(path)
    again = load_field(path)
    assert again.metadata == alone.metadata
    np.testing.assert_array_equal(again.occupied, alone.occupied)
    upper = box.copy()
    upper[0, 2] = box[:, 2].mean()
    higher = cropped(again, upper)
    assert higher.metadata.space.corners is not None
    assert higher.metadata.space.corners[0, 2] > alone.metadata.space.corners[0, 2]
    assert cropped(higher, box).metadata.space == higher.metadata.space
    assert cropped(higher, box).metadata.error_scale == 1.5


def test_boxes_that_hold_nothing_are_refused(demo: Field) -> None:
    for box in ([[0, 0, 0], [0, 1, 1]], [[90, 90, 90], [91, 91, 91]], [[-0.01, -3.2, 2.7], [0.01, -3.19, 2.71]]):
        with pytest.raises(ConfigError, match="nothing of the field is in the box"):
            cropped(demo, np.array(box, float))
