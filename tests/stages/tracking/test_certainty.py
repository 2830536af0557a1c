"""Covariances of believed poses by what a field has shown on its training images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.tracking_world import ring_of_views

from fieldpose.bus.messages import GuessReason
from fieldpose.stages.geometry import exp_se3
from fieldpose.stages.tracking.certainty import Certainty
from fieldpose.stages.tracking.config import TrackingConfig
from fieldpose.stages.tracking.frame_policies import EachFramePolicy
from fieldpose.stages.tracking.policy import Attempt, FrameInfo, Policy, PoseGuess, PoseResult
from fieldpose.stages.tracking.track_policy import TrackPolicy

COVARIANCE = np.diag([1e-4] * 3 + [1e-5] * 3)
SCALE = 2.0


def turned(degrees: float) -> np.ndarray:
    return exp_se3(np.array([0, 0, 0, 0, 0, np.deg2rad(degrees)]))


@given(st.floats(0.25, 4.0), st.floats(0, 180), st.floats(0, 180))
def test_it_counts_in_full_at_the_guess_and_less_the_farther_the_pose_is(first: float, near: float, far: float) -> None:
    certainty = Certainty(first, SCALE)
    near, far = sorted((near, far))
    ratios = [
        np.trace(certainty.of(COVARIANCE, np.eye(4), turned(angle))) / np.trace(COVARIANCE)  # type: ignore[arg-type]
        for angle in (0, near, far)
    ]
    assert ratios[0] == pytest.approx(first**2, rel=1e-6)
    off = [abs(ratio - 1) for ratio in ratios]
    assert off[0] >= off[1] - 1e-9 >= off[2] - 2e-9


def test_elsewhere_the_field_makes_no_difference() -> None:
    certainty = Certainty(3.0, SCALE)
    np.testing.assert_array_equal(certainty.of(COVARIANCE, np.eye(4), turned(12)), COVARIANCE)
    shifted = exp_se3(np.array([0.3 * SCALE, 0, 0, 0, 0, 0]))
    np.testing.assert_array_equal(certainty.of(COVARIANCE, np.eye(4), shifted), COVARIANCE)
    assert certainty.of(None, np.eye(4), np.eye(4)) is None


@pytest.mark.parametrize("following", [False, True])
def test_policies_state_it(following: bool) -> None:
    views = replace(ring_of_views(), error_scale=0.5)
    pose, config = views.cam_from_object[5], TrackingConfig()
    policy: Policy = TrackPolicy(config, views, pose) if following else EachFramePolicy(config, views, {0: pose})
    frame = FrameInfo(0, 0)
    guess = policy.first_guess(frame)
    assert guess is not None
    attempt = Attempt(frame, PoseGuess(GuessReason.PRIOR, guess.cam_from_object, guess.epoch), 0)
    result = PoseResult(0, 0, True, pose, COVARIANCE, 150, 200, 1.0)
    assert policy.next_guess(attempt, result) is None
    belief = policy.conclude(attempt, result)
    assert belief.covariance is not None
    np.testing.assert_allclose(belief.covariance, COVARIANCE / 4)
