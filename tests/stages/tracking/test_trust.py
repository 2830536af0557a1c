"""The four states, and the score that moves between them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldpose.bus.messages import TrackingState
from fieldpose.stages.geometry import Limit
from fieldpose.stages.tracking.config import ScoreConfig
from fieldpose.stages.tracking.policy import PoseResult
from fieldpose.stages.tracking.scoring import deviations, score
from fieldpose.stages.tracking.trust import Trust

GOOD = PoseResult(0, 0, np.eye(4), np.diag([1e-6] * 6), inliers=100, correspondences=120, residual_px=0.8)


def tracking(**settings: int) -> Trust:
    trust = Trust(**{"lost_after": 4, "weak_after": 12, "patience": 3, **settings})
    trust.good()
    return trust


def test_a_failure_limits_and_failures_in_a_row_lose() -> None:
    trust, states = tracking(), []
    for _ in range(4):
        trust.rejected()
        states.append(trust.state)
    assert states == [TrackingState.LIMITED] * 3 + [TrackingState.LOST]


def test_a_good_pose_takes_all_strikes_back() -> None:
    trust = tracking()
    for _ in range(3):
        trust.rejected()
    trust.good()
    assert trust.state is TrackingState.TRACKING
    trust.rejected()
    assert trust.state is TrackingState.LIMITED


@pytest.mark.parametrize("strikes", [0, 2])
def test_what_turns_out_to_be_wrong_is_lost_at_once(strikes: int) -> None:
    trust = tracking()
    for _ in range(strikes):
        trust.rejected()
    before = trust.epoch
    trust.lost()
    assert (trust.state, trust.tracked, trust.epoch) == (TrackingState.LOST, False, before + 1)
    trust.lost()
    assert trust.epoch == before + 1
    trust.good()
    assert (trust.state, trust.epoch) == (TrackingState.TRACKING, before + 2)
    trust.rejected()
    assert trust.state is TrackingState.LIMITED


def test_where_nothing_is_tracked_nothing_can_be_lost() -> None:
    trust = Trust(4, 12, 3)
    trust.lost()
    assert (trust.state, trust.epoch) == (TrackingState.INITIALIZING, 0)


def test_weak_poses_do_not_end_tracking_at_once_nor_restore_it() -> None:
    trust, states = tracking(), []
    for _ in range(12):
        trust.weak()
        states.append(trust.state)
    assert states == [TrackingState.TRACKING] * 2 + [TrackingState.LIMITED] * 9 + [TrackingState.LOST]
    trust.weak()
    assert trust.state is TrackingState.LIMITED


def test_losses_and_recoveries_begin_a_new_epoch() -> None:
    trust = tracking()
    first = trust.epoch
    trust.rejected()
    trust.good()
    assert trust.epoch == first
    for _ in range(9):
        trust.rejected()
    assert trust.epoch == first + 1
    trust.good()
    assert trust.epoch == first + 2


def test_initializing_has_a_patience_of_its_own() -> None:
    trust = Trust(lost_after=5, weak_after=20, patience=2)
    trust.rejected()
    assert trust.state is TrackingState.INITIALIZING
    trust.rejected()
    assert trust.state is TrackingState.LOST


def test_silence_limits_but_never_loses() -> None:
    trust = tracking()
    for _ in range(20):
        trust.stale()
    assert trust.state is TrackingState.LIMITED


@given(st.lists(st.sampled_from(["good", "weak", "rejected", "stale"]), max_size=50))
def test_after_the_first_pose_it_never_initializes_again(events: list[str]) -> None:
    trust = tracking()
    for event in events:
        getattr(trust, event)()
        assert trust.state is not TrackingState.INITIALIZING
        assert trust.tracked == (trust.state is not TrackingState.LOST)


def test_score_is_one_for_a_good_pose_and_zero_for_none() -> None:
    assert score(GOOD, ScoreConfig()) == 1.0
    assert score(replace(GOOD, cam_from_object=None), ScoreConfig()) == 0.0
    assert score(replace(GOOD, inliers=7), ScoreConfig()) == 0.0


@pytest.mark.parametrize(
    ("worse", "expected"),
    [
        ({"inliers": 20, "correspondences": 20}, 0.5),
        ({"correspondences": 500}, 0.5),
        ({"residual_px": 8.0}, 0.25),
        ({"covariance": np.diag([0.0016, 0, 0, 0, 0, 0])}, 0.5),
        ({"covariance": np.diag([0, 0, 0, 0, 0, np.deg2rad(4) ** 2])}, 0.25),
        ({"covariance": None, "residual_px": None}, 1.0),
    ],
)
def test_score_is_that_of_the_weakest_measure(worse: dict, expected: float) -> None:
    config = ScoreConfig(good_inliers=40, good_inlier_ratio=0.4, good_residual_px=2, good_sigma=Limit(1.0, 0.02))
    assert score(replace(GOOD, **worse), config) == pytest.approx(expected)


def test_deviations_of_a_twist_covariance() -> None:
    sigma, sigma_deg = deviations(np.diag([9.0, 16.0, 0, 0, 0, np.deg2rad(2) ** 2]))
    assert (sigma, sigma_deg) == (pytest.approx(5), pytest.approx(2))


def test_score_of_the_translation_scales_with_the_scene() -> None:
    uncertain = replace(GOOD, covariance=np.diag([0.0016, 0, 0, 0, 0, 0]))
    assert score(uncertain, ScoreConfig(), scale=1.0) < score(uncertain, ScoreConfig(), scale=2.0) == 1.0
