"""Fitting a pose to the points that agree, and how certain it is; images from coarse to fine."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
import pytest
from support.pictures import picture

from fieldpose.stages.alignment.agreement import covariance_of, fit_agreeing
from fieldpose.stages.alignment.images import FramePyramid, pyramid
from fieldpose.stages.alignment.least_squares import PoseFit, isotropic
from fieldpose.stages.geometry import Camera, exp_se3, look_at, rotation_error_deg, scale_pixels, translation_error

LENS = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)
TRUTH = look_at((3.0, 1.0, 1.5), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
START = exp_se3([0.01, -0.01, 0.01, 0.003, 0.002, -0.003]) @ TRUTH
COUNT = 120


def seen(noise_px: float = 0.1, wrong: float = 0.0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Pixels and points; the first of them, a share `wrong`, are 20 pixels off or more."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.6, 0.6, (COUNT, 3))
    pixels = LENS.project(points @ TRUTH[:3, :3].T + TRUTH[:3, 3]) + rng.normal(0, noise_px, (COUNT, 2))
    count = int(wrong * COUNT)
    pixels[:count] += rng.choice([-1, 1], (count, 2)) * rng.uniform(20, 60, (count, 2))
    return pixels, points


def fitted(pixels: np.ndarray, points: np.ndarray, threshold: float = 4.0) -> tuple[PoseFit, np.ndarray]:
    fit, agreeing = fit_agreeing(pixels, points, LENS, START, isotropic(np.ones(len(points))), threshold, 8)
    assert fit is not None
    return fit, agreeing


@pytest.mark.parametrize("wrong", [0.0, 0.3, 0.6])
@pytest.mark.parametrize("seed", range(3))
def test_points_that_are_elsewhere_are_left_out(wrong: float, seed: int) -> None:
    fit, agreeing = fitted(*seen(wrong=wrong, seed=seed))
    assert not agreeing[: int(wrong * COUNT)].any()
    assert agreeing[int(wrong * COUNT) :].all()
    assert len(fit.pixels) == agreeing.sum()
    assert rotation_error_deg(fit.cam_from_object, TRUTH) < 0.1
    assert translation_error(fit.cam_from_object, TRUTH) < 0.005


def test_points_that_a_better_pose_brings_near_are_taken_in() -> None:
    """At the start half of them are beyond the threshold."""
    pixels, points = seen(noise_px=0.02)
    projected = LENS.project(points @ START[:3, :3].T + START[:3, 3])
    threshold = float(np.median(np.linalg.norm(projected - pixels, axis=1)))
    assert fitted(pixels, points, threshold)[1].all()


def test_too_few_that_agree_are_no_pose() -> None:
    pixels, points = seen(wrong=0.95)
    fit, agreeing = fit_agreeing(pixels, points, LENS, START, isotropic(np.ones(COUNT)), 4.0, 8)
    assert fit is None
    assert agreeing.sum() < 8
    assert fit_agreeing(pixels[:0], points[:0], LENS, START, isotropic(np.ones(0)), 4.0, 1)[0] is None


def test_where_each_is_taken_the_robust_loss_leaves_out_a_few() -> None:
    fit, agreeing = fitted(*seen(wrong=0.1), threshold=np.inf)
    assert agreeing.all()
    assert rotation_error_deg(fit.cam_from_object, TRUTH) < 0.5


def test_the_more_differently_points_were_seen_the_less_certain_the_pose() -> None:
    fit, agreeing = fitted(*seen(noise_px=0.5))
    pixels = seen(noise_px=0.5)[0][agreeing]
    covariances = [covariance_of(fit, pixels, 320, angle) for angle in (0.0, 0.1, 0.3, 1.0)]
    for smaller, larger in pairwise(covariances):
        assert (np.linalg.eigvalsh(larger - smaller) > 0).all()
        np.testing.assert_allclose(larger, larger.T, rtol=1e-6)


def test_the_noisier_the_pixels_the_less_certain_the_pose() -> None:
    traces = []
    for noise_px in (0.1, 0.4, 1.0):
        pixels, points = seen(noise_px)
        fit, agreeing = fitted(pixels, points)
        traces.append(np.trace(covariance_of(fit, pixels[agreeing], 320, 0.1)))
    assert traces[1] > 4 * traces[0]
    assert traces[2] > 2 * traces[1]


@pytest.mark.parametrize("size", [(640, 480), (641, 480), (320, 240), (100, 75), (31, 17)])
def test_each_level_is_half_as_large_and_its_pixels_every_other_one(size: tuple[int, int]) -> None:
    """A slope stays what it is but for the border."""
    x, y = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    levels = pyramid(((x + y) % 256).astype(np.uint8), 3)
    assert levels[0].dtype == np.float32
    np.testing.assert_allclose(levels[0][:9, :9], (x + y)[:9, :9] / 255, atol=1e-6)
    for finer, coarser in pairwise(levels):
        assert coarser.shape == ((finer.shape[0] + 1) // 2, (finer.shape[1] + 1) // 2)
    np.testing.assert_allclose(levels[1][1:7, 1:7], levels[0][2:14:2, 2:14:2], atol=1e-4)


@pytest.mark.parametrize("before", [1, 2, 3], ids=["whole", "half", "third"])
def test_a_frame_that_was_shrunk_before_tells_its_scale_to_what_was_taken(before: int) -> None:
    taken = Camera(640, 480, 600.0, 600.0, 319.5, 239.5)
    grey = cv2.cvtColor(picture(1, 640)[:480], cv2.COLOR_RGB2GRAY)
    small = cv2.resize(grey, (640 // before, 480 // before), interpolation=cv2.INTER_AREA)
    frame = FramePyramid.of(small, taken, 160, 3)
    assert frame.levels[0].shape == (120, 160) == (frame.camera.height, frame.camera.width)
    np.testing.assert_array_equal(frame.scale, [0.25, 0.25])
    point = np.array([[0.2, -0.1, 1.0]])
    np.testing.assert_allclose(frame.camera.project(point), scale_pixels(taken.project(point), frame.scale), atol=0.01)
    whole = cv2.resize(grey, (160, 120), interpolation=cv2.INTER_AREA)
    assert np.abs(frame.levels[0] * 255 - whole).mean() < 1.0


def test_a_frame_smaller_than_views_is_not_enlarged() -> None:
    frame = FramePyramid.of(np.zeros((240, 320), np.uint8), LENS, 800, 3)
    assert frame.camera == LENS
    np.testing.assert_array_equal(frame.scale, [1.0, 1.0])
