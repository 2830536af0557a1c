"""The pose filter: laws of what it gives, on motions that are known."""

import numpy as np
import pytest

from fieldpose.stages.geometry import exp_se3, inverse, log_se3
from fieldpose.stages.tracking.smoothing import PoseFilter

STEP_NS = 33_000_000
START = exp_se3([0.1, -0.2, 3.0, 0.2, 0.1, -0.3])
NOISE_SIGMA = np.array([2e-3] * 3 + [5e-4] * 3)
NOISE = np.diag(NOISE_SIGMA**2)


def path(kind: str, i: int) -> np.ndarray:
    seconds = i * STEP_NS * 1e-9
    if kind == "still":
        return START
    if kind == "steady":
        return exp_se3(np.array([0.3, 0.1, 0, 0, 0.5, 0.1]) * seconds) @ START
    return exp_se3([0.3 * np.sin(4 * seconds), 0, 0.1 * seconds, 0, 0.6 * np.sin(5 * seconds), 0]) @ START


def errors(kind: str, count: int = 200, seed: int = 0) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Twists of what is measured and of what is filtered from the truth, and the covariances."""
    rng, smooth = np.random.default_rng(seed), PoseFilter()
    raw, filtered, covariances = [], [], []
    for i in range(count):
        truth = path(kind, i)
        measured = exp_se3(rng.normal(0, NOISE_SIGMA)) @ truth
        pose, covariance = smooth.update(i * STEP_NS, measured, NOISE)
        raw.append(log_se3(measured @ inverse(truth)))
        filtered.append(log_se3(pose @ inverse(truth)))
        covariances.append(covariance)
    return np.array(raw[20:]), np.array(filtered[20:]), covariances[20:]


@pytest.mark.parametrize(("kind", "share"), [("still", 0.75), ("steady", 0.8), ("swaying", 1.0)])
def test_it_is_nearer_to_the_truth_than_what_is_measured(kind: str, share: float) -> None:
    raw, filtered, _ = errors(kind)
    for part in (slice(0, 3), slice(3, 6)):
        assert (filtered[:, part] ** 2).mean() < share**2 * (raw[:, part] ** 2).mean() + 1e-12


def test_fast_motion_is_not_held_back() -> None:
    """At 60 degrees a second that come at once, the mean error is that of the noise."""
    smooth, rng, off = PoseFilter(), np.random.default_rng(1), []
    for i in range(60):
        turn = max(0, i - 30) * STEP_NS * 1e-9 * np.deg2rad(60.0)
        truth = exp_se3([0, 0, 0, 0, turn, 0]) @ START
        pose, _ = smooth.update(i * STEP_NS, exp_se3(rng.normal(0, NOISE_SIGMA)) @ truth, NOISE)
        off.append(log_se3(pose @ inverse(truth))[4])
    assert np.abs(off[31:]).max() < 4 * NOISE_SIGMA[4]


def test_its_covariance_is_that_of_the_error() -> None:
    _, filtered, covariances = errors("steady", 400)
    squared = np.mean([e @ np.linalg.solve(c, e) for e, c in zip(filtered, covariances, strict=True)])
    assert 3 < squared < 12
    for covariance in covariances:
        assert np.allclose(covariance, covariance.T)
        assert np.linalg.eigvalsh(covariance).min() > 0


def test_it_does_not_depend_on_where_the_object_frame_is() -> None:
    other, rng = exp_se3([0.3, 2.0, -1.0, 0.5, 0.2, 1.0]), np.random.default_rng(2)
    first, second = PoseFilter(), PoseFilter()
    for i in range(30):
        measured = exp_se3(rng.normal(0, NOISE_SIGMA)) @ path("swaying", i)
        # Distances from the origin set the least acceleration alone, which this motion is far above.
        one, _ = first.update(i * STEP_NS, measured, NOISE)
        two, _ = second.update(i * STEP_NS, measured @ other, NOISE)
        assert np.allclose(one @ other, two, atol=2e-3)


def test_stamps_that_do_not_advance_and_long_gaps_give_what_is_measured() -> None:
    smooth = PoseFilter()
    for at_ns in (10**9, 10**9, 9 * 10**8, 3 * 10**9):
        measured = exp_se3([at_ns * 1e-9, 0, 0, 0, 0.1, 0]) @ START
        pose, covariance = smooth.update(at_ns, measured, NOISE)
        assert np.array_equal(pose, measured)
        assert np.array_equal(covariance, NOISE)
