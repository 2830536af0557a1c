import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldpose.stages.geometry import (
    camera_centre,
    inverse,
    is_rigid,
    look_at,
    perturb,
    rotation_about,
    rotation_error_deg,
    translation_error,
    viewing_angles,
)
from fieldpose.stages.geometry.rigid import from_rotation

POSE = look_at((3.0, -2.0, 1.0), (0.2, 0.1, 0.0), (0, 0, 1))
seeds = st.integers(0, 2**32 - 1)


@given(st.floats(0, 180), st.tuples(*[st.floats(-5, 5)] * 3))
def test_errors_measure_the_angle_and_the_way_of_the_camera(angle_deg: float, way: tuple[float, float, float]) -> None:
    turned = rotation_about((1, 2, -1), np.deg2rad(angle_deg)) @ POSE
    assert rotation_error_deg(POSE, turned) == pytest.approx(angle_deg, abs=1e-5)
    assert translation_error(POSE, turned) == pytest.approx(0, abs=1e-12)
    shifted = POSE @ from_rotation(np.eye(3), way)
    assert translation_error(POSE, shifted) == pytest.approx(np.linalg.norm(way), abs=1e-9)
    assert rotation_error_deg(POSE, shifted) == pytest.approx(0, abs=1e-5)


@given(seeds, st.floats(0, 60), st.floats(0, 60), st.floats(0, 1))
def test_perturb_stays_within_its_limits(seed: int, low: float, more: float, limit: float) -> None:
    centre = np.array([0.5, -0.3, 0.2])
    guess = perturb(POSE, np.random.default_rng(seed), (low, low + more), limit, centre)
    assert is_rigid(guess, 1e-9)
    assert low - 1e-6 <= rotation_error_deg(guess, POSE) <= low + more + 1e-6
    # The whole motion is a turn about the centre, then a shift: the centre itself moves by the shift alone.
    moved = inverse(guess) @ POSE
    assert np.linalg.norm((moved @ [*centre, 1])[:3] - centre) <= limit + 1e-9


@given(seeds)
def test_perturb_without_translation_keeps_the_distance(seed: int) -> None:
    centre = np.array([0.5, -0.3, 0.2])
    guess = perturb(POSE, np.random.default_rng(seed), max_translation=0.0, centre=centre)
    before, after = (np.linalg.norm(camera_centre(pose) - centre) for pose in (POSE, guess))
    assert after == pytest.approx(before)
    np.testing.assert_allclose((guess @ [*centre, 1])[:3], (POSE @ [*centre, 1])[:3], atol=1e-9)


def test_perturb_fills_its_limits_and_repeats_with_its_seed() -> None:
    rng = np.random.default_rng(3)
    guesses = [perturb(POSE, rng) for _ in range(300)]
    angles = [rotation_error_deg(guess, POSE) for guess in guesses]
    shifts = [np.linalg.norm((inverse(guess) @ POSE)[:3, 3]) for guess in guesses]
    assert 10 <= min(angles) < 11
    assert 39 < max(angles) <= 40
    assert min(shifts) < 0.01
    assert 0.19 < max(shifts) <= 0.2
    np.testing.assert_array_equal(guesses[0], perturb(POSE, np.random.default_rng(3)))


@given(seeds, st.floats(0, 180))
def test_viewing_angles_are_those_of_cameras_around_a_point(seed: int, angle_deg: float) -> None:
    """Turned about the axis through a point, cameras at right angles to it see the point from that angle."""
    rng = np.random.default_rng(seed)
    centre, radius = rng.uniform(-1, 1, 3), rng.uniform(2, 5)
    angle = np.deg2rad(angle_deg)
    eyes = [centre + radius * np.array((np.cos(a), np.sin(a), 0)) for a in (0.0, angle)]
    first, second = (look_at(eye, (0, 0, 0.1), (0, 0, 1)) for eye in eyes)
    seen = viewing_angles(centre[None], first, second)
    assert seen == pytest.approx([angle], abs=1e-6)
    assert viewing_angles(centre[None], second, first) == pytest.approx(seen, abs=1e-6)
    assert viewing_angles(centre[None], first, first) == pytest.approx([0], abs=1e-6)
