"""A camera that turns on the spot: the shift of the image tells by how much."""

import numpy as np
import pytest
from support.analytic_scene import AnalyticScene, camera, viewpoint

from fieldpose.stages.alignment.images import FramePyramid
from fieldpose.stages.following.config import LEVELS
from fieldpose.stages.following.turning import turned
from fieldpose.stages.geometry import exp_se3, rotation_error_deg

LENS, POSE = camera(200), viewpoint(25.0, 38.0)


def seen(pose: np.ndarray) -> FramePyramid:
    grey = AnalyticScene().render_view(LENS, pose).rgb.mean(axis=2).astype(np.uint8)
    return FramePyramid.of(grey, LENS, 200, LEVELS)


@pytest.mark.parametrize("turn", [(0.0, 0.0), (0.0, 0.12), (-0.1, 0.0), (0.06, -0.08)])
def test_a_turn_is_told_to_a_pixel_or_two_of_the_small_image(turn: tuple[float, float]) -> None:
    moved = exp_se3([0, 0, 0, *turn, 0]) @ POSE
    told = turned(seen(POSE), seen(moved))
    assert told is not None
    assert rotation_error_deg(told @ POSE, moved) < 0.25 * np.rad2deg(np.hypot(*turn)) + 0.5


def test_images_of_different_sizes_cannot_be_compared() -> None:
    small = FramePyramid.of(np.zeros((80, 80), np.uint8), camera(80), 80, LEVELS)
    assert turned(small, seen(POSE)) is None
