from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.analytic_scene import AnalyticScene, camera, viewpoint

from fieldpose.stages.geometry import Camera, exp_se3, perturb, rays, rotation_error_deg, translation_error
from fieldpose.stages.refinement.core import RefinementConfig, RefinementResult, refine
from fieldpose.stages.refinement.photometric import Photometric, keypoint_region

CAMERA = camera(160)
POSE = viewpoint()
CONFIG = RefinementConfig(samples=300, held_out=150)


@pytest.fixture(scope="module")
def scene() -> AnalyticScene:
    return AnalyticScene()


@pytest.fixture(scope="module")
def image(scene: AnalyticScene) -> np.ndarray:
    return frame_of(scene, CAMERA)


@pytest.fixture(scope="module")
def keypoints(scene: AnalyticScene) -> np.ndarray:
    return keypoints_of(scene, CAMERA)


def frame_of(scene: AnalyticScene, cam: Camera, pose: np.ndarray = POSE) -> np.ndarray:
    rgb = scene.render_rays(*rays(cam, pose)).rgb.reshape(cam.height, cam.width, 3)
    return np.clip(np.rint(rgb * 255), 0, 255).astype(np.uint8)


def keypoints_of(scene: AnalyticScene, cam: Camera, count: int = 80) -> np.ndarray:
    solid = cam.grid()[scene.render_rays(*rays(cam, POSE)).opacity > 0.9]
    return solid[np.random.default_rng(0).choice(len(solid), count, replace=False)]


def guess(seed: int, angle_deg: float = 1.0, shift: float = 0.03) -> np.ndarray:
    return perturb(POSE, np.random.default_rng(seed), (angle_deg, angle_deg), shift)


def error(result: RefinementResult) -> float:
    return rotation_error_deg(result.cam_from_object, POSE)


def test_the_gradient_is_that_of_the_loss(scene: AnalyticScene, image: np.ndarray) -> None:
    photometric = Photometric(scene, RefinementConfig(colours="rgb", outlier=10.0, derivative="field"))
    solid = CAMERA.grid()[scene.render_rays(*rays(CAMERA, POSE)).opacity > 0.99][::29]
    sample = photometric.sample(image, CAMERA, solid)
    pose = exp_se3([0.003, 0.002, -0.004, 0.002, -0.001, 0.003]) @ POSE
    steps = 1e-4 * np.eye(6)
    numeric = [
        (photometric.loss(sample, exp_se3(s) @ pose) - photometric.loss(sample, exp_se3(-s) @ pose)) for s in steps
    ]
    np.testing.assert_allclose(
        photometric.linearise(sample, pose).gradient, np.array(numeric) / 2e-4, rtol=0.05, atol=2e-3
    )


@pytest.mark.parametrize(
    ("changes", "within_deg"),
    [
        ({}, 0.05),
        ({"colours": "rgb"}, 0.05),
        ({"background": "compare"}, 0.15),
        ({"derivative": "field"}, 0.02),
        ({"optimiser": "adam"}, 0.4),
        ({"optimiser": "adam", "derivative": "field"}, 0.4),
    ],
)
def test_refinement_recovers_the_pose(
    scene: AnalyticScene, image: np.ndarray, keypoints: np.ndarray, changes: dict[str, Any], within_deg: float
) -> None:
    config = replace(CONFIG, **changes)
    for seed in range(3):
        result = refine(scene, image, CAMERA, guess(seed), keypoints, config)
        assert result.refined
        assert 0 < result.steps <= 40
        assert error(result) < within_deg
        assert translation_error(result.cam_from_object, POSE) < 0.07 * within_deg + 1e-3


@pytest.mark.parametrize("seed", range(8))
def test_the_result_is_never_worse_by_the_loss_that_it_reports(
    scene: AnalyticScene, image: np.ndarray, keypoints: np.ndarray, seed: int
) -> None:
    """From the pose itself, from near by, and from so far that refinement goes astray."""
    start = guess(seed, [0.0, 0.5, 6.0, 25.0][seed % 4], [0.0, 0.02, 0.3, 0.5][seed % 4])
    result = refine(scene, image, CAMERA, start, keypoints, CONFIG)
    assert result.loss_before is not None
    assert result.loss_after is not None
    assert result.refined == (result.loss_after < result.loss_before)
    if not result.refined:
        assert np.array_equal(result.cam_from_object, start)


def test_keypoint_guided_sampling_beats_uniform_under_occlusion(scene: AnalyticScene, image: np.ndarray) -> None:
    """Something textured hides a third of the object; keypoints are on the rest."""
    rng = np.random.default_rng(1)
    occluded = image.copy()
    occluded[40:160, 75:160] = np.kron(rng.integers(0, 256, (24, 17, 3)), np.ones((5, 5, 1))).astype(np.uint8)
    keypoints = keypoints_of(scene, CAMERA, 160)
    visible = keypoints[(keypoints[:, 0] < 68) | (keypoints[:, 1] < 33)]
    errors = {}
    for region in ("keypoints", "image"):
        config = replace(CONFIG, region=region)
        results = [refine(scene, occluded, CAMERA, guess(seed), visible, config) for seed in range(5)]
        errors[region] = np.array([error(result) for result in results])
    assert errors["keypoints"].max() < 0.1
    assert np.median(errors["keypoints"]) < 0.2 * np.median(errors["image"])


def test_an_unknown_background_does_not_matter(scene: AnalyticScene, image: np.ndarray, keypoints: np.ndarray) -> None:
    opacity = scene.render_rays(*rays(CAMERA, POSE)).opacity.reshape(160, 160, 1)
    clutter = np.random.default_rng(2).integers(0, 256, image.shape)
    elsewhere = (opacity * image + (1 - opacity) * clutter).astype(np.uint8)
    result = refine(scene, elsewhere, CAMERA, guess(4), keypoints, CONFIG)
    assert error(result) < 0.05


def test_distortion_is_removed_from_the_frames_rays(scene: AnalyticScene) -> None:
    lens = camera(160, (-0.15, 0.04, 0.002, -0.001, 0.0))
    image, keypoints = frame_of(scene, lens), keypoints_of(scene, lens)
    assert error(refine(scene, image, lens, guess(5), keypoints, CONFIG)) < 0.06


def test_a_large_frame_is_shrunk_with_its_camera_and_keypoints(scene: AnalyticScene, keypoints: np.ndarray) -> None:
    large = CAMERA.resized(2 * CAMERA.width, 2 * CAMERA.height)
    image, at_large = frame_of(scene, large), (keypoints + 0.5) * 2 - 0.5
    config = RefinementConfig(samples=300, held_out=150, size=160)
    assert error(refine(scene, image, large, guess(6), at_large, config)) < 0.05


def test_nothing_to_compare_leaves_the_pose_as_it_is(scene: AnalyticScene, image: np.ndarray) -> None:
    start, off, none = guess(7), RefinementConfig(steps=0), np.zeros((0, 2))
    away = np.diag([1.0, -1.0, -1.0, 1.0]) @ start
    for pose, points, config in (
        (start, CAMERA.grid()[::50], off),
        (start, none, CONFIG),
        (away, CAMERA.grid(), CONFIG),
    ):
        result = refine(scene, image, CAMERA, pose, points, config)
        assert not result.refined
        assert result.loss_before is None
        assert np.array_equal(result.cam_from_object, pose)


def test_the_same_input_gives_the_same_pose(scene: AnalyticScene, image: np.ndarray, keypoints: np.ndarray) -> None:
    first, second = (refine(scene, image, CAMERA, guess(8), keypoints, CONFIG) for _ in range(2))
    assert np.array_equal(first.cam_from_object, second.cam_from_object)


def test_the_region_is_the_keypoints_dilated_by_five_pixels_n_times() -> None:
    cam = Camera(40, 30, 40.0, 40.0, 19.5, 14.5)
    keypoints = np.array([[10.2, 9.8], [500.0, -3.0]])
    for n, width in ((0, 1), (1, 5), (2, 9), (3, 13)):
        region = keypoint_region(keypoints, cam, n)
        assert region.sum() == width**2
        assert region[10 - width // 2 : 11 + width // 2, 10 - width // 2 : 11 + width // 2].all()


def test_a_refined_pose_has_a_covariance_of_its_own(
    scene: AnalyticScene, image: np.ndarray, keypoints: np.ndarray
) -> None:
    refined = refine(scene, image, CAMERA, guess(3), keypoints, CONFIG)
    assert refined.refined
    assert refined.covariance is not None
    assert np.linalg.eigvalsh(refined.covariance).min() > 0
    sigma_deg = np.rad2deg(np.sqrt(np.trace(refined.covariance[3:, 3:])))
    assert error(refined) < 4 * sigma_deg < 2.0
    at_once = refine(scene, image, CAMERA, POSE, keypoints, replace(CONFIG, steps=0))
    assert at_once.covariance is None


def test_pixels_without_weight_do_not_count_in_the_covariance(scene: AnalyticScene, image: np.ndarray) -> None:
    photometric = Photometric(scene, CONFIG)
    opacity = scene.render_rays(*rays(CAMERA, POSE)).opacity
    solid, empty = CAMERA.grid()[opacity > 0.99][::7], CAMERA.grid()[opacity < 0.01][:600]
    alone, _ = photometric.weighted_by_opacity(photometric.sample(image, CAMERA, solid), POSE)
    both = photometric.sample(image, CAMERA, np.concatenate([solid, empty]))
    padded, _ = photometric.weighted_by_opacity(both, POSE)
    expected = photometric.covariance(alone, POSE, CAMERA, 0.7)
    np.testing.assert_allclose(photometric.covariance(padded, POSE, CAMERA, 0.7), expected, rtol=1e-3)
