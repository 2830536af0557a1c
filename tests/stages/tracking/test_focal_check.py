"""A camera that is not as said makes no pose certain, and once it is known not to be, one frame does not clear it."""

from __future__ import annotations

import numpy as np
import pytest

from fieldpose.bus.messages import Reason, TrackingState
from fieldpose.stages.tracking.certainty import FocalCheck
from fieldpose.stages.tracking.policy import Belief

TRACKING = Belief(TrackingState.TRACKING, 1.0, np.eye(4), 1e-6 * np.eye(6))


def check_of(*errors: float, sigma: float = 1e-3) -> FocalCheck:
    check = FocalCheck()
    for error in errors:
        check.note(error, sigma)
        check.applied(TRACKING)
    return check


@pytest.mark.parametrize("error", [0.0, 0.012, -0.02])
def test_small_errors_change_nothing(error: float) -> None:
    assert check_of(*[error] * 20).applied(TRACKING) is TRACKING


@pytest.mark.parametrize("error", [0.05, -0.04])
def test_a_focal_length_that_differs_is_told_and_no_pose_is_sure(error: float) -> None:
    belief = check_of(*[error] * 20).applied(TRACKING)
    assert (belief.state, belief.reason) == (TrackingState.LIMITED, Reason.CAMERA_DIFFERS)
    assert belief.score < TRACKING.score
    assert belief.covariance is not None
    assert np.all(np.diag(belief.covariance)[3:] >= error**2 / 3)


def test_what_has_differed_does_until_it_seems_right_again() -> None:
    doubtful, right = [0.02] * 200, [0.0] * 200
    assert check_of(*doubtful).applied(TRACKING) is TRACKING
    assert check_of(*[0.05] * 20, *doubtful).applied(TRACKING).state is TrackingState.LIMITED
    assert check_of(*[0.05] * 20, *doubtful, *right).applied(TRACKING) is TRACKING


def test_frames_that_tell_little_count_for_little() -> None:
    check = check_of(*[0.0] * 20)
    check.note(0.5, 10.0)
    assert check.applied(TRACKING) is TRACKING


def test_of_what_is_small_more_is_asked() -> None:
    """A field's shape errs; of what tells little of the focal length it says the more of it."""
    assert check_of(*[0.07] * 100, sigma=0.016).applied(TRACKING) is TRACKING
    assert check_of(*[0.2] * 100, sigma=0.016).applied(TRACKING).reason is Reason.CAMERA_DIFFERS


def test_frames_that_tell_nothing_change_nothing() -> None:
    assert check_of(0.0, sigma=np.inf).applied(TRACKING) is TRACKING
    check = check_of(*[0.05] * 20)
    check.note(0.0, np.inf)
    assert check.applied(TRACKING).state is TrackingState.LIMITED
    assert np.isfinite(check.error)
