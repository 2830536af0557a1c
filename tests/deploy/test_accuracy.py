"""What is found out about a field by looking for its own training images in it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.analytic_scene import AnalyticScene, camera, viewpoint

from fieldpose.deploy.evaluation.accuracy import TooFew, in_words, pose_accuracy
from fieldpose.deploy.local import photo_finder
from fieldpose.deploy.settings import Settings, changed
from fieldpose.stages.geometry import perturb
from fieldpose.stages.nerf.metadata import PoseAccuracy
from fieldpose.stages.nerf.training_views import TrainingViews

SETTINGS = changed(Settings(), {"matching": {"matcher": "sift"}}, "test")
SEEN_BY = camera(160)
POSES = [viewpoint(azimuth) for azimuth in range(0, 100, 10)]


def views_at(poses: list[np.ndarray]) -> TrainingViews:
    return TrainingViews(tuple(f"{i}" for i in range(len(poses))), np.stack(poses))


@pytest.fixture(scope="module")
def scene() -> AnalyticScene:
    return AnalyticScene()


@pytest.fixture(scope="module")
def images(scene: AnalyticScene) -> list[np.ndarray]:
    return [scene.render_view(SEEN_BY, pose).rgb for pose in POSES]


def measured(scene: AnalyticScene, images: list[np.ndarray], poses: list[np.ndarray]) -> PoseAccuracy | TooFew:
    return pose_accuracy(scene, views_at(poses), images, [SEEN_BY] * len(images), SETTINGS)


def test_inexact_poses_of_a_dataset_show(scene: AnalyticScene, images: list[np.ndarray]) -> None:
    exact = measured(scene, images, POSES)
    rng = np.random.default_rng(0)
    inexact = measured(scene, images, [perturb(pose, rng, (0.5, 0.5), 0.02) for pose in POSES])
    assert isinstance(exact, PoseAccuracy)
    assert isinstance(inexact, PoseAccuracy)
    assert exact.images == exact.found == inexact.found == len(POSES)
    assert exact.rotation_deg < 0.1
    assert exact.translation < 0.01
    assert 0.3 < inexact.rotation_deg < 1
    assert inexact.error_scale > 2 * exact.error_scale
    assert "are the dataset's poses" not in in_words(exact)
    assert "are the dataset's poses and its camera right?" in in_words(inexact)


def test_what_is_not_found_tells_nothing(scene: AnalyticScene, images: list[np.ndarray]) -> None:
    blank = [np.full_like(image, 255) for image in images]
    assert measured(scene, blank, POSES) == TooFew(len(POSES), 0)
    assert measured(scene, [*images[:7], *blank[7:]], POSES) == TooFew(len(POSES), 7)
    assert measured(scene, images[:1], POSES[:1]) == TooFew(1, 0)
    assert in_words(TooFew(24, 0)) == (
        "0 of 24 training images are found: are the dataset's poses, their axes and its camera right?"
    )
    assert "too few to tell how exactly" in in_words(TooFew(5, 5))


def test_few_that_are_found_are_a_reason_to_doubt() -> None:
    assert in_words(PoseAccuracy(32, 32, 0.0131, 0.00087, 0.9)) == (
        "the pose of a training image is found to 0.013 degrees and 0.00087 units in the median, 32 of 32"
    )
    assert "are the dataset's poses" in in_words(PoseAccuracy(32, 20, 0.01, 0.001, 0.9))


def test_a_pose_is_as_certain_as_the_field_has_shown(scene: AnalyticScene, images: list[np.ndarray]) -> None:
    views = views_at(POSES)
    plain = photo_finder(SETTINGS, views, scene).find(images[3], SEEN_BY, POSES[3])
    scaled = photo_finder(SETTINGS, replace(views, error_scale=2.0), scene).find(images[3], SEEN_BY, POSES[3])
    assert plain.covariance is not None
    assert scaled.covariance is not None
    np.testing.assert_array_equal(scaled.cam_from_object, plain.cam_from_object)
    assert 3.9 < np.trace(scaled.covariance) / np.trace(plain.covariance) <= 4
