"""The demo scene that is shipped: its true depths must tell the same story from every camera, as read."""

from pathlib import Path

import numpy as np
import pytest

from fieldpose.stages.geometry import rays, translation_error
from fieldpose.stages.nerf.datasets import load_dataset

DEMO = Path(__file__).parents[3] / "recordings" / "demo"
pytestmark = pytest.mark.skipif(not (DEMO / "transforms_test.json").is_file(), reason="no demo scene in this checkout")


def test_the_demo_scene_is_a_bounded_one() -> None:
    train, test = load_dataset(DEMO, "train"), load_dataset(DEMO, "test")
    assert (train.scene, len(train), len(test), train.metres_per_unit) == ("bounded", 100, 25, 0.1)
    assert (train.load_image(0).shape, train.background) == ((400, 400, 3), None)


@pytest.mark.parametrize("first", [0, 7])
def test_depths_agree_between_views_and_lie_within_the_boxes(first: int) -> None:
    dataset = load_dataset(DEMO, "test")
    a = dataset.images[first]
    apart = [translation_error(record.cam_from_object, a.cam_from_object) for record in dataset.images]
    second = int(np.argsort(apart)[1])
    b = dataset.images[second]
    origins, directions = rays(a.camera, a.cam_from_object)
    points = origins + dataset.load_depth(first).reshape(-1, 1) * directions
    in_b = points @ b.cam_from_object[:3, :3].T + b.cam_from_object[:3, 3]
    pixels = np.rint(b.camera.project(in_b))
    seen = ((pixels >= 0) & (pixels < b.camera.width)).all(axis=1)
    x, y = pixels[seen].astype(int).T
    difference = in_b[seen, 2] - dataset.load_depth(second)[y, x]
    assert abs(np.median(difference)) < 1e-3
    assert (np.abs(difference) < 0.02).mean() > 0.7
    assert dataset.object_aabb is not None
    lowest, highest = dataset.bounds.aabb
    assert ((points > lowest - 1e-3) & (points < highest + 1e-3)).all()
    lowest, highest = dataset.object_aabb
    assert ((points > lowest - 0.01) & (points < highest + 0.01)).all(axis=1)[dataset.load_mask(first).ravel()].all()
