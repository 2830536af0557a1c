"""Laws of the motion model."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldpose.stages.geometry import Limit, exp_se3, inverse, log_se3
from fieldpose.stages.tracking.config import MotionConfig
from fieldpose.stages.tracking.motion import MotionModel

SECOND = 1_000_000_000
UNDAMPED = MotionConfig(damping_ms=float("inf"), most=Limit(180, 100), horizon_ms=1e6)
small = st.floats(-1.0, 1.0, allow_nan=False)
twists = st.tuples(*[small] * 6)


def moving(twist: tuple[float, ...], start: tuple[float, ...], at_s: float) -> np.ndarray:
    return exp_se3(np.array(twist) * at_s) @ exp_se3(start)


@given(twists, twists, st.lists(st.integers(1, 200), min_size=2, max_size=8), st.integers(-300, 300))
def test_a_constant_twist_is_predicted_exactly(
    twist: tuple[float, ...], start: tuple[float, ...], steps_ms: list[int], ahead_ms: int
) -> None:
    model = MotionModel(UNDAMPED)
    times_ms = np.cumsum(steps_ms)
    for ms in times_ms:
        model.add(int(ms) * 1_000_000, moving(twist, start, ms * 1e-3))
    wanted_ms = int(times_ms[-1]) + ahead_ms
    predicted = model.predict(wanted_ms * 1_000_000)
    np.testing.assert_allclose(predicted, moving(twist, start, wanted_ms * 1e-3), atol=1e-6)


@given(st.permutations(range(5)))
def test_the_order_of_arrival_does_not_matter(order: list[int]) -> None:
    poses = [exp_se3([0.1 * i, 0.02 * i * i, 0, 0, 0.05 * i, 0]) for i in range(5)]
    shuffled, sorted_ = MotionModel(MotionConfig()), MotionModel(MotionConfig())
    for i in order:
        shuffled.add(i * SECOND // 30, poses[i])
    for i in range(5):
        sorted_.add(i * SECOND // 30, poses[i])
    np.testing.assert_array_equal(shuffled.predict(SECOND // 4), sorted_.predict(SECOND // 4))


def two_poses(config: MotionConfig, scale: float = 1.0, twist: tuple[float, ...] = (1, 0, 0, 0, 0, 1)) -> MotionModel:
    model = MotionModel(config, scale)
    for ms in (0, 100):
        model.add(ms * 1_000_000, moving(twist, (0,) * 6, ms * 1e-3))
    return model


def ahead(model: MotionModel, ms: int) -> np.ndarray:
    """The twist from the newest pose to the prediction."""
    return log_se3(model.predict(model.newest_ns + ms * 1_000_000) @ inverse(model.newest))


def test_damping_follows_short_motions_and_stops_long_ones() -> None:
    model = two_poses(MotionConfig(damping_ms=200))
    assert ahead(model, 10)[0] == pytest.approx(0.01, rel=0.03)
    assert ahead(model, 10_000)[0] == pytest.approx(0.2)
    assert ahead(model, -10_000)[0] == pytest.approx(-0.2)
    np.testing.assert_allclose(ahead(two_poses(MotionConfig(damping_ms=0)), 100), 0, atol=1e-12)


def test_predictions_are_clamped_without_changing_their_direction() -> None:
    fast = two_poses(MotionConfig(most=Limit(10, 50)), twist=(1, 2, 0, 0, 0, 5))
    turned = ahead(fast, 900)
    assert np.rad2deg(np.linalg.norm(turned[3:])) == pytest.approx(10)
    np.testing.assert_allclose(turned / np.linalg.norm(turned), np.array([1, 2, 0, 0, 0, 5]) / np.sqrt(30), atol=1e-9)
    shifted = ahead(two_poses(MotionConfig(most=Limit(20, 0.1)), scale=0.5, twist=(3, 0, 0, 0, 0, 0)), 900)
    assert shifted[0] == pytest.approx(0.05)


def test_poses_too_far_apart_in_time_say_nothing_about_the_velocity() -> None:
    model = MotionModel(MotionConfig(horizon_ms=500))
    model.add(0, np.eye(4))
    model.add(SECOND, exp_se3([1, 0, 0, 0, 0, 0]))
    assert np.all(model.velocity() == 0)
    assert model.within_horizon(SECOND + SECOND // 2)
    assert not model.within_horizon(2 * SECOND)


def test_a_second_pose_of_a_time_replaces_the_first_and_reset_forgets() -> None:
    model = MotionModel(MotionConfig())
    model.add(0, np.eye(4))
    model.add(0, exp_se3([0, 0, 1, 0, 0, 0]))
    assert len(model) == 1
    assert model.newest[2, 3] == 1
    model.reset()
    assert len(model) == 0
    assert not model.within_horizon(0)
