"""Real datasets, where they lie beside the project: neighbouring photographs must agree on where things are.

Nothing here trusts a convention: SIFT matches two images, and poses and intrinsics as read must explain that.
"""

from pathlib import Path

import cv2
import numpy as np
import pytest

from fieldpose.stages.geometry import inverse, translation_error
from fieldpose.stages.nerf.datasets import Dataset, ImageRecord, load_dataset

DATA = Path(__file__).parents[3].parent / "shared" / "data"


def needs(name: str) -> pytest.MarkDecorator:
    return pytest.mark.skipif(not (DATA / name).is_dir(), reason=f"../shared/data/{name} is not there")


def matches(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (n, 2) of mutual nearest SIFT neighbours."""
    sift = cv2.SIFT_create(2000)
    (points_a, a), (points_b, b) = (
        sift.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None) for image in (first, second)
    )
    found = cv2.BFMatcher(cv2.NORM_L2, crossCheck=True).match(a, b)
    distance = np.array([match.distance for match in found])
    good = [found[i] for i in np.argsort(distance)[: len(found) // 2]]
    return (
        np.array([points_a[match.queryIdx].pt for match in good]),
        np.array([points_b[match.trainIdx].pt for match in good]),
    )


def sampson_px(rays_a: np.ndarray, rays_b: np.ndarray, b_from_a: np.ndarray, focal: float) -> np.ndarray:
    """First-order distance to the epipolar constraint (Hartley and Zisserman, eq. 11.9), in pixels."""
    x, y, z = b_from_a[:3, 3]
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ b_from_a[:3, :3]
    lines_b, lines_a = rays_a @ essential.T, rays_b @ essential
    gradient = np.hypot(np.hypot(lines_a[:, 0], lines_a[:, 1]), np.hypot(lines_b[:, 0], lines_b[:, 1]))
    return focal * np.abs((rays_b * lines_b).sum(axis=1)) / gradient


def depths(rays_a: np.ndarray, rays_b: np.ndarray, b_from_a: np.ndarray) -> np.ndarray:
    """(n, 2): the depths in both cameras at which two rays pass nearest to each other."""
    result = []
    for ray_a, ray_b in zip(rays_a, rays_b, strict=True):
        system = np.stack([b_from_a[:3, :3] @ ray_a, -ray_b], axis=1)
        result.append(np.linalg.lstsq(system, -b_from_a[:3, 3], rcond=None)[0])
    return np.array(result)


def check_pair(dataset: Dataset, i: int, j: int) -> tuple[np.ndarray, ImageRecord]:
    """Median epipolar error below 1 px, matched points ahead of both cameras; returns them in camera i's frame."""
    a, b = dataset.images[i], dataset.images[j]
    pixels_a, pixels_b = matches(dataset.load_rgb(i), dataset.load_rgb(j))
    rays_a = a.camera.directions(pixels_a).astype(np.float64)
    rays_b = b.camera.directions(pixels_b).astype(np.float64)
    b_from_a = b.cam_from_object @ inverse(a.cam_from_object)
    error = sampson_px(rays_a, rays_b, b_from_a, a.camera.fx)
    explained = error < 2
    assert len(error) > 60
    assert np.median(error) < 1.0
    found = depths(rays_a[explained], rays_b[explained], b_from_a)
    assert (found > 0).all(axis=1).mean() > 0.9
    return found[:, :1] * rays_a[explained], a


@needs("lego")
def test_lego() -> None:
    train, test = load_dataset(DATA / "lego", "train", size=400), load_dataset(DATA / "lego", "test")
    assert (train.kind, train.scene, len(train), len(test)) == ("blender", "object", 100, 25)
    assert test.images[0].camera.width == 800
    np.testing.assert_allclose(train.bounds.aabb, [[-1.5] * 3, [1.5] * 3], atol=0.05)
    apart = [translation_error(record.cam_from_object, train.images[0].cam_from_object) for record in train.images]
    seen, record = check_pair(load_dataset(DATA / "lego", "train"), 0, int(np.argsort(apart)[1]))
    points_in_object = (seen - record.cam_from_object[:3, 3]) @ record.cam_from_object[:3, :3]
    assert (np.abs(points_in_object).max(axis=1) < 1.3).mean() > 0.9


@needs("fern")
@pytest.mark.parametrize("normalise", [True, False])
def test_fern(normalise: bool) -> None:
    dataset = load_dataset(DATA / "fern", "all", size=1008, llff_normalise=normalise)
    assert (dataset.kind, len(dataset)) == ("llff", 20)
    assert [record.split for record in dataset.images].count("test") == 3
    for i, j in ((0, 1), (6, 12)):
        seen, record = check_pair(dataset, i, j)
        assert record.near is not None
        assert record.far is not None
        assert 0.9 * record.near < np.percentile(seen[:, 2], 5)
        assert np.percentile(seen[:, 2], 90) < 1.1 * record.far


@needs("fox")
def test_fox() -> None:
    dataset = load_dataset(DATA / "fox", "all", size=960)
    assert (dataset.kind, dataset.scene, len(dataset)) == ("transforms", "unbounded", 50)
    assert len(load_dataset(DATA / "fox", "train")) == len(load_dataset(DATA / "fox", "test")) == 25
    assert len(dataset.notes) == 1
    for i, j in ((0, 2), (20, 22)):
        seen, _ = check_pair(dataset, i, j)
        assert dataset.bounds.near < np.percentile(seen[:, 2], 5)
