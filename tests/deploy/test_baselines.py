"""The published methods that fieldpose is compared with descend rightly, and find what they can find."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from support.analytic_scene import AnalyticScene, camera, viewpoint

from fieldpose.deploy.evaluation.baselines import BASELINES, Essential, Inerf, InerfConfig, PiNerf, PiNerfConfig
from fieldpose.deploy.evaluation.baselines.descent import left_jacobian
from fieldpose.deploy.evaluation.baselines.inerf import interest_region, squared_error
from fieldpose.deploy.evaluation.baselines.pinerf import Hypotheses, Target, errors, loss, resampled
from fieldpose.deploy.settings import Settings
from fieldpose.stages.geometry import (
    Camera,
    camera_centre,
    exp_se3,
    inverse,
    perturb,
    rotation_error_deg,
    translation_error,
)
from fieldpose.stages.matching.core import MatchingConfig

CAMERA = camera(160)
POSE = viewpoint()
FLAT = np.full((CAMERA.height, CAMERA.width, 3), 255, np.uint8)
SIFT = Settings(matching=MatchingConfig(matcher="sift"))
FEW = PiNerfConfig(steps=320, hypotheses=12, rays=24, angle_deg=12.0, prune_every=160, shift_rate=0.02, turn_rate=0.01)


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """The scene's tensors are too small to be shared out among threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def scene() -> AnalyticScene:
    return AnalyticScene()


@pytest.fixture(scope="module")
def image(scene: AnalyticScene) -> np.ndarray:
    return scene.render_view(CAMERA, POSE).rgb


def guess(angle_deg: float, shift: float = 0.05, seed: int = 1) -> np.ndarray:
    return perturb(POSE, np.random.default_rng(seed), (angle_deg, angle_deg), shift)


def solid_target(scene: AnalyticScene, image: np.ndarray, cam: Camera = CAMERA) -> Target:
    """Pixels inside the silhouette at POSE, where the scene is smooth enough for finite differences."""
    solid = (scene.render_view(cam, POSE).opacity > 0.99).ravel()
    return Target(cam.directions(cam.grid())[solid], image.reshape(-1, 3)[solid].astype(np.float32) / 255).part(
        np.arange(0, solid.sum(), 29)
    )


def test_the_left_jacobian_is_the_derivative_of_the_exponential() -> None:
    twist, change = np.array([0.4, -0.7, 0.2, 0.9, -0.5, 1.1]), 1e-6 * np.array([1.0, 2, -1, 0.5, -2, 1])
    np.testing.assert_allclose(
        exp_se3(twist + change), exp_se3(left_jacobian(twist) @ change) @ exp_se3(twist), atol=1e-11
    )


def test_inerf_descends_the_gradient_of_its_loss(scene: AnalyticScene, image: np.ndarray) -> None:
    sample = solid_target(scene, image)
    twist = np.array([0.3, -0.2, 0.5, 0.4, -0.6, 0.3])
    start = exp_se3(-twist) @ inverse(exp_se3([0.003, 0.002, -0.004, 0.002, -0.001, 0.003]) @ POSE)

    def value(at: np.ndarray) -> float:
        return squared_error(scene, start, at, sample.directions, sample.colours)[0]

    numeric = [(value(twist + step) - value(twist - step)) / 2e-4 for step in 1e-4 * np.eye(6)]
    _, gradient = squared_error(scene, start, twist, sample.directions, sample.colours)
    np.testing.assert_allclose(gradient, numeric, rtol=0.05, atol=2e-3)


@pytest.mark.parametrize("turn_about", ["camera", "origin"])
@pytest.mark.parametrize("kind", ["l2", "log-l1"])
def test_pi_nerf_descends_the_gradient_of_its_loss(
    scene: AnalyticScene, image: np.ndarray, turn_about: str, kind: str
) -> None:
    config = PiNerfConfig(turn_about=turn_about, loss=kind)  # type: ignore[arg-type]
    sample = solid_target(scene, image)
    both = Target(*(np.repeat(values[None], 2, axis=0) for values in (sample.directions, sample.colours)))
    poses = [exp_se3(0.003 * np.array(twist)) @ POSE for twist in ([1, 1, -1, 1, 0, 1.0], [0, -1, 1, 0, 1, -1.0])]

    def values(motion: np.ndarray) -> np.ndarray:
        moved = Hypotheses.of(poses)
        moved.move(np.tile(motion[:3], (2, 1)), np.tile(motion[3:], (2, 1)), turn_about == "origin")
        return errors(scene, moved, both, config)[0]

    numeric = np.stack([(values(step) - values(-step)) / 2e-4 for step in 1e-4 * np.eye(6)], axis=1)
    _, gradient = errors(scene, Hypotheses.of(poses), both, config)
    np.testing.assert_allclose(gradient, numeric, rtol=0.05, atol=0.01)


@pytest.mark.parametrize("kind", ["mape", "l1", "l2", "log-l1"])
def test_losses_have_the_slopes_that_they_state(kind: str) -> None:
    residuals, colours, step = np.array([-0.4, -0.1, 0.2, 0.7]), np.array([0.9, 0.1, 0.0, 0.3]), 1e-6
    numeric = (loss(residuals + step, colours, kind)[0] - loss(residuals - step, colours, kind)[0]) / (2 * step)
    np.testing.assert_allclose(loss(residuals, colours, kind)[1], numeric, rtol=1e-5)


def test_inerf_finds_a_pose_from_a_small_perturbation(scene: AnalyticScene, image: np.ndarray) -> None:
    found = Inerf(scene, InerfConfig(rays=200, steps=120)).find(image, CAMERA, guess(6.0))
    assert found is not None
    assert rotation_error_deg(found, POSE) < 1.0
    assert translation_error(found, POSE) < 0.08


def test_the_interest_region_lies_around_the_keypoints(image: np.ndarray) -> None:
    small, large = interest_region(image, CAMERA, 0), interest_region(image, CAMERA, 3)
    assert 0 < len(small) < len(large) < CAMERA.width * CAMERA.height
    distances = np.abs(large[:, None] - small[None]).max(axis=2).min(axis=1)
    assert distances.max() == 6


def test_pi_nerf_finds_a_pose_from_a_larger_one(scene: AnalyticScene, image: np.ndarray) -> None:
    found = PiNerf(scene, FEW).find(image, CAMERA, guess(14.0))
    assert found is not None
    assert rotation_error_deg(found, POSE) < 2.0


@pytest.mark.parametrize(
    "make",
    [
        lambda scene: Inerf(scene, InerfConfig(rays=64, steps=4), seed=3),
        lambda scene: PiNerf(scene, replace(FEW, steps=16, prune_every=8), seed=3),
        lambda scene: Essential(scene, SIFT),
    ],
)
def test_answers_are_repeated(
    make: Callable[[AnalyticScene], Inerf | PiNerf | Essential], scene: AnalyticScene, image: np.ndarray
) -> None:
    np.testing.assert_array_equal(*(make(scene).find(image, CAMERA, guess(5.0)) for _ in range(2)))


def test_pruning_keeps_the_best_and_draws_the_others_around_them(scene: AnalyticScene, image: np.ndarray) -> None:
    angles = (9.0, 0.5, 12.0, 3.0, 20.0, 15.0, 25.0, 30.0)
    hypotheses = Hypotheses.of([guess(angle, 0.0) for angle in angles])
    target = Target(CAMERA.directions(CAMERA.grid()), image.reshape(-1, 3).astype(np.float32) / 255)
    rng = np.random.default_rng(0)
    order = PiNerf(scene, FEW).ranking(hypotheses, target, rng)
    assert list(order[:2]) == [1, 3]
    again = resampled(hypotheses, order, FEW, rng)
    best = [again.cam_from_object(i) for i in range(2)]
    np.testing.assert_allclose(best, [hypotheses.cam_from_object(1), hypotheses.cam_from_object(3)], atol=1e-12)
    for i in range(2, len(angles)):
        drawn = again.cam_from_object(i)
        assert min(rotation_error_deg(drawn, pose) for pose in best) <= FEW.angle_again_deg + 1e-6


def test_the_essential_matrix_tells_the_rotation_and_the_direction(scene: AnalyticScene) -> None:
    cam = camera(400)
    start = guess(15.0, seed=4)
    found = Essential(scene, SIFT).relative(scene.render_view(cam, POSE).rgb, cam, start)
    assert found is not None
    assert not found.scale_known
    assert rotation_error_deg(found.cam_from_object, POSE) < 1.5
    np.testing.assert_allclose(camera_centre(found.cam_from_object), camera_centre(start), atol=1e-9)
    moved = camera_centre(POSE) - camera_centre(start)
    assert found.direction @ moved / np.linalg.norm(moved) > 0.99


def test_an_image_with_nothing_to_find_is_no_error(scene: AnalyticScene) -> None:
    assert Inerf(scene).find(FLAT, CAMERA, POSE) is None
    assert Essential(scene, SIFT).find(FLAT, CAMERA, POSE) is None
    anything = PiNerf(scene, PiNerfConfig(steps=16, hypotheses=4, rays=8, prune_every=8)).find(FLAT, CAMERA, POSE)
    assert anything is not None
    assert np.isfinite(anything).all()


def test_only_the_essential_matrix_leaves_the_scale_open() -> None:
    assert set(BASELINES) == {"inerf", "pi-nerf", "essential"}
    assert [kind.scale_known for kind in (Inerf, PiNerf, Essential)] == [True, True, False]
