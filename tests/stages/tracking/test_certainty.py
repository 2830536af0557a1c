"""How certain believed poses are: by what a field has shown on its training images, and by the camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.tracking_world import frame_info, on_sphere, ring_of_views

from fieldpose.bus.messages import CameraOrigin, Reason, TrackingState
from fieldpose.stages.geometry import exp_se3
from fieldpose.stages.tracking.certainty import Certainty, with_camera
from fieldpose.stages.tracking.config import TrackingConfig
from fieldpose.stages.tracking.photos import PhotoPolicy
from fieldpose.stages.tracking.policy import Attempt, Belief, Policy, PoseGuess, PoseResult
from fieldpose.stages.tracking.priors import Priors
from fieldpose.stages.tracking.video import VideoPolicy

COVARIANCE = np.diag([1e-4] * 3 + [1e-5] * 3)
SCALE = 2.0
SURE = Belief(TrackingState.TRACKING, 0.9, on_sphere(20, 30), COVARIANCE)


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


@pytest.mark.parametrize("kind", [PhotoPolicy, VideoPolicy])
def test_policies_state_it(kind: type[PhotoPolicy] | type[VideoPolicy]) -> None:
    views = replace(ring_of_views(), error_scale=0.5)
    pose, frame = views.cam_from_object[5], frame_info()
    policy: Policy = kind(TrackingConfig(), views, Priors(), pose)
    guess = policy.first_step(frame)
    assert isinstance(guess, PoseGuess)
    attempt = Attempt(frame, 0).again(guess, 0)
    result = PoseResult(0, 0, pose, COVARIANCE, 150, 200, 1.0)
    assert policy.next_step(attempt, result) is None
    belief = policy.conclude(attempt, result)
    assert belief.covariance is not None
    np.testing.assert_allclose(belief.covariance, COVARIANCE / 4)


def added(origin: CameraOrigin, belief: Belief = SURE) -> np.ndarray:
    """What a camera of that origin adds to the covariance."""
    covariance = with_camera(belief, frame_info(origin=origin)).covariance
    assert covariance is not None
    assert belief.covariance is not None
    return covariance - belief.covariance


@pytest.mark.parametrize("origin", [CameraOrigin.CALIBRATED, CameraOrigin.TRAINING])
def test_a_known_camera_takes_nothing_from_a_belief(origin: CameraOrigin) -> None:
    assert with_camera(SURE, frame_info(origin=origin)) is SURE


def test_an_assumed_camera_limits_a_belief() -> None:
    belief = with_camera(SURE, frame_info(origin=CameraOrigin.ASSUMED))
    assert (belief.state, belief.score) == (TrackingState.LIMITED, 0.3)
    assert belief.cam_from_object is SURE.cam_from_object
    assert (np.linalg.eigvalsh(added(CameraOrigin.ASSUMED)) > 0).all()
    weak = with_camera(replace(SURE, score=0.21), frame_info(origin=CameraOrigin.ASSUMED))
    assert weak.score == 0.21


def test_a_camera_from_exif_is_less_certain_than_a_known_one_and_more_than_an_assumed_one() -> None:
    belief = with_camera(SURE, frame_info(origin=CameraOrigin.EXIF))
    assert (belief.state, belief.score) == (SURE.state, SURE.score)
    exif, assumed = added(CameraOrigin.EXIF), added(CameraOrigin.ASSUMED)
    assert (np.linalg.eigvalsh(exif) > 0).all()
    assert (np.linalg.eigvalsh(assumed - exif) > 0).all()


@given(st.floats(0.1, 100.0), st.sampled_from([CameraOrigin.EXIF, CameraOrigin.ASSUMED]))
def test_the_position_is_the_less_certain_the_farther_the_camera_is(distance: float, origin: CameraOrigin) -> None:
    near, far = (added(origin, replace(SURE, cam_from_object=on_sphere(20, 30, d))) for d in (distance, 2 * distance))
    assert np.trace(far[:3, :3]) == pytest.approx(4 * np.trace(near[:3, :3]))
    np.testing.assert_allclose(far[3:, 3:], near[3:, 3:], atol=1e-12)


@pytest.mark.parametrize("origin", list(CameraOrigin))
@pytest.mark.parametrize(
    "belief",
    [
        Belief(TrackingState.LOST, 0.0, reason=Reason.NO_CONSENSUS),
        Belief(TrackingState.INITIALIZING, 0.0, reason=Reason.NO_ANSWER),
        Belief(TrackingState.LIMITED, 0.0, on_sphere(0, 0), reason=Reason.NO_ANSWER),
    ],
    ids=["lost", "initializing", "carried on"],
)
def test_no_camera_makes_more_of_a_belief_without_a_measurement(belief: Belief, origin: CameraOrigin) -> None:
    assert with_camera(belief, frame_info(origin=origin)) == belief
