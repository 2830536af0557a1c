"""Residuals tell a focal length that is not as said, in a law: what is put in comes out."""

import numpy as np
import pytest

from fieldpose.stages.alignment.focal import focal_error
from fieldpose.stages.alignment.least_squares import fit_pose, isotropic
from fieldpose.stages.geometry import Camera, exp_se3

TRUE = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)
POSE = exp_se3([0.1, -0.1, 3.0, 0.2, -0.1, 0.1])


def fitted(points: np.ndarray, off: float, noise_px: float = 0.0) -> tuple[float, float]:
    """What is found where the focal length is longer than said by a share `off`."""
    said = Camera(320, 240, 300.0 / (1 + off), 300.0 / (1 + off), 159.5, 119.5)
    pixels = TRUE.project(points @ POSE[:3, :3].T + POSE[:3, 3])
    pixels += np.random.default_rng(1).normal(0, noise_px, pixels.shape)
    return focal_error(fit_pose(pixels, points, said, POSE, isotropic(np.ones(len(points)))))


@pytest.mark.parametrize("off", [-0.08, -0.02, 0.0, 0.03, 0.06])
def test_points_at_many_depths_tell_it(off: float) -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (200, 3))
    found, sigma = fitted(points, off, 0.05)
    assert found == pytest.approx(off, abs=max(0.15 * abs(off), 4 * sigma))
    assert sigma < 0.01


def test_a_plane_seen_from_the_front_tells_nothing() -> None:
    flat = np.random.default_rng(0).uniform(-1, 1, (200, 3))
    flat[:, 2] = 0.0
    facing = (flat - POSE[:3, 3] + [0.1, -0.1, 3.0]) @ POSE[:3, :3]
    deep, plane = fitted(np.random.default_rng(0).uniform(-1, 1, (200, 3)), 0.0, 0.1)[1], fitted(facing, 0.0, 0.1)[1]
    assert plane > 5 * deep
