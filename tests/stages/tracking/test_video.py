"""The policy step by step: which guess follows from what, and which poses are believed."""

from __future__ import annotations

import numpy as np
import pytest
from fieldpose.stages.tracking.retrieved import RetrievedPoses
from fieldpose.stages.tracking.track_policy import TrackPolicy
from support.tracking_world import on_sphere, ring_of_views

from fieldpose.bus.messages import GuessReason, TrackingState
from fieldpose.stages.geometry import rotation_error_deg
from fieldpose.stages.tracking.config import TrackingConfig
from fieldpose.stages.tracking.policy import Attempt, Belief, FrameInfo, PoseGuess, PoseResult

MS = 1_000_000
VIEWS = ring_of_views()
START = on_sphere(0, 30)


class Camera:
    """Hands frames to a policy every 50 ms, one after another, and the results that a test wants."""

    def __init__(self, start: np.ndarray | None = START, **config: object) -> None:
        self.retrieved = RetrievedPoses()
        self.policy = TrackPolicy(TrackingConfig(**config), VIEWS, start, self.retrieved)  # type: ignore[arg-type]
        self.frame_id = -1

    def attempt(self, skip: int = 0) -> Attempt:
        self.frame_id += 1 + skip
        frame = FrameInfo(self.frame_id, self.frame_id * 50 * MS)
        guess = self.policy.first_guess(frame)
        assert guess is not None
        return Attempt(frame, guess, 0)

    def guess(self) -> PoseGuess:
        return self.attempt().guess

    def conclude(self, attempt: Attempt, pose: np.ndarray | None, inliers: int = 100) -> Belief:
        """The belief after a result that is asked no further pass for."""
        result = PoseResult(attempt.frame.frame_id, 0, pose is not None, pose, None, inliers, 120, 1.0)
        return self.policy.conclude(attempt, result)

    def see(self, pose: np.ndarray | None, inliers: int = 100, skip: int = 0) -> Belief:
        return self.conclude(self.attempt(skip), pose, inliers)

    def lose(self) -> None:
        while self.see(None).state is not TrackingState.LOST:
            pass


def tracking(**config: object) -> Camera:
    """After ten frames along a circle, one degree a frame; the last at 9 degrees."""
    camera = Camera(**config)
    for i in range(10):
        assert camera.see(on_sphere(i, 30)).state is TrackingState.TRACKING
    return camera


def test_the_guess_runs_ahead_with_the_motion() -> None:
    guess = tracking().guess()
    assert guess.reason is GuessReason.MOTION
    assert rotation_error_deg(guess.cam_from_object, on_sphere(10, 30)) < 0.2
    assert rotation_error_deg(guess.cam_from_object, on_sphere(9, 30)) > 0.7


def test_a_limited_track_takes_turns_between_motion_and_keyframes() -> None:
    camera = tracking()
    camera.see(None)
    guesses = [camera.guess() for _ in range(4)]
    assert {guesses[0].reason, guesses[1].reason} == {GuessReason.MOTION, GuessReason.KEYFRAME}
    assert [g.reason for g in guesses[2:]] == [g.reason for g in guesses[:2]]
    keyframe = next(g for g in guesses if g.reason is GuessReason.KEYFRAME)
    np.testing.assert_array_equal(keyframe.cam_from_object, on_sphere(6, 30))


def test_after_a_long_gap_the_last_pose_is_the_guess() -> None:
    camera = tracking()
    guess = camera.attempt(skip=30).guess
    assert guess.reason is GuessReason.KEYFRAME
    np.testing.assert_array_equal(guess.cam_from_object, on_sphere(9, 30))


def test_a_jump_waits_for_a_second_frame_and_then_begins_a_new_motion() -> None:
    camera = tracking(jump_deg_per_s=10)
    first = camera.see(on_sphere(60, 30))
    assert first.state is TrackingState.LIMITED
    assert rotation_error_deg(first.cam_from_object, on_sphere(10, 30)) < 1
    second = camera.see(on_sphere(60, 30))
    assert second.state is TrackingState.TRACKING
    np.testing.assert_array_equal(second.cam_from_object, on_sphere(60, 30))
    guess = camera.guess()
    assert guess.reason is GuessReason.MOTION
    assert rotation_error_deg(guess.cam_from_object, on_sphere(60, 30)) < 1e-6


def test_two_jumps_to_different_places_confirm_nothing() -> None:
    camera = tracking(jump_deg_per_s=10)
    assert camera.see(on_sphere(60, 30)).state is TrackingState.LIMITED
    assert camera.see(on_sphere(120, 30)).state is TrackingState.LIMITED
    assert camera.see(on_sphere(12, 30)).state is TrackingState.TRACKING


def test_a_jump_is_forgotten_once_the_track_goes_on() -> None:
    camera = tracking(jump_deg_per_s=10)
    camera.see(on_sphere(60, 30))
    assert camera.see(on_sphere(11, 30)).state is TrackingState.TRACKING
    assert camera.see(on_sphere(60, 30)).state is TrackingState.LIMITED


def test_what_was_under_way_before_a_recovery_is_not_held_against_it() -> None:
    camera = tracking()
    camera.lose()
    stray = camera.attempt()
    found = camera.attempt()
    assert camera.conclude(found, found.guess.cam_from_object).state is TrackingState.TRACKING
    assert camera.conclude(stray, None).state is TrackingState.TRACKING
    assert camera.see(None).state is TrackingState.LIMITED


def failed(attempt: Attempt) -> PoseResult:
    return PoseResult(attempt.frame.frame_id, attempt.pass_index, False)


def test_a_lost_video_goes_on_from_what_looks_like_its_frames() -> None:
    camera = tracking()
    camera.lose()
    attempt = camera.attempt()
    alike = on_sphere(77, 20)
    camera.retrieved.add(attempt.frame.frame_id, attempt.frame.capture_ns, [alike])
    guess = camera.policy.next_guess(attempt, failed(attempt))
    assert guess is not None
    assert guess.reason is GuessReason.RELOCALISATION
    assert guess.cam_from_object is alike
    camera.retrieved.add(attempt.frame.frame_id, attempt.frame.capture_ns, [on_sphere(78, 20)])
    np.testing.assert_array_equal(camera.guess().cam_from_object, on_sphere(78, 20))


def test_a_photo_that_the_last_pose_does_not_lead_to_is_searched_for_at_once() -> None:
    camera = Camera(sequence="photos", searches=3)
    assert camera.see(START).state is TrackingState.TRACKING
    attempt, alike = camera.attempt(), [on_sphere(100, 20), on_sphere(130, 20)]
    tried = []
    for _ in range(3):
        guess = camera.policy.next_guess(attempt, failed(attempt))
        assert guess is not None
        assert guess.reason is GuessReason.RELOCALISATION
        tried.append(guess.cam_from_object)
        camera.retrieved.add(attempt.frame.frame_id, attempt.frame.capture_ns, alike)
        attempt = attempt.again(guess, 0)
    assert camera.policy.next_guess(attempt, failed(attempt)) is None
    assert tried[1] is alike[0]
    assert tried[2] is not alike[0]
    assert camera.attempt().guess.reason is GuessReason.KEYFRAME


def test_a_loss_is_followed_by_the_last_pose_and_by_training_views() -> None:
    camera = tracking()
    camera.lose()
    guesses = [camera.guess() for _ in range(4)]
    assert {guess.reason for guess in guesses} == {GuessReason.RELOCALISATION}
    np.testing.assert_array_equal(guesses[0].cam_from_object, on_sphere(9, 30))
    for guess in guesses[1::2]:
        assert any(np.array_equal(guess.cam_from_object, view) for view in VIEWS.cam_from_object)


def test_a_pose_far_from_its_guess_is_tried_as_the_next_guess() -> None:
    camera = tracking()
    camera.lose()
    attempt = camera.attempt()
    assert camera.conclude(attempt, found := on_sphere(40, 30)).state is TrackingState.LOST
    again = camera.attempt()
    assert again.guess.cam_from_object is found
    assert camera.conclude(again, on_sphere(40.2, 30)).state is TrackingState.TRACKING


def test_a_weak_pose_needs_a_second_frame_to_begin_a_track() -> None:
    camera = Camera()
    assert camera.see(START, inliers=20).state is TrackingState.INITIALIZING
    belief = camera.see(START, inliers=20)
    assert belief.state is TrackingState.LIMITED
    assert belief.cam_from_object is START
    assert camera.see(START).state is TrackingState.TRACKING


def test_a_pose_with_too_few_inliers_is_a_failure() -> None:
    camera = tracking()
    belief = camera.see(on_sphere(10, 30), inliers=5)
    assert (belief.state, belief.score) == (TrackingState.LIMITED, 0.0)


def test_lost_messages_limit_the_track_only_after_the_horizon() -> None:
    camera = tracking()
    soon = camera.policy.missed(FrameInfo(12, 600 * MS))
    assert soon.state is TrackingState.TRACKING
    assert soon.cam_from_object is not None
    late = camera.policy.missed(FrameInfo(99, 5_000 * MS))
    assert (late.state, late.cam_from_object) == (TrackingState.LIMITED, None)


def test_a_start_that_does_not_work_out_is_given_up() -> None:
    camera = Camera(lost_after=3)
    reasons = []
    for _ in range(5):
        attempt = camera.attempt()
        reasons.append(attempt.guess.reason)
        camera.conclude(attempt, None)
    assert reasons == [GuessReason.PRIOR] * 3 + [GuessReason.RELOCALISATION] * 2


@pytest.mark.parametrize(("moved_deg", "expected"), [(0.1, None), (20, GuessReason.NEXT_PASS)])
def test_another_pass_is_asked_for_where_the_pose_moved(moved_deg: float, expected: GuessReason | None) -> None:
    camera = Camera()
    attempt = camera.attempt()
    result = PoseResult(0, 0, True, on_sphere(moved_deg, 30), None, 100, 120, 1.0)
    guess = camera.policy.next_guess(attempt, result)
    assert (guess and guess.reason) is expected


def test_a_track_takes_a_pose_near_its_motion_without_another_pass() -> None:
    camera = tracking()
    attempt = camera.attempt()
    near, far = (PoseResult(10, 0, True, on_sphere(a, 30), None, 100, 120, 1.0) for a in (13, 40))
    assert camera.policy.next_guess(attempt, near) is None
    assert camera.policy.next_guess(attempt, far) is not None


def test_no_more_passes_than_configured() -> None:
    camera = Camera(passes=2)
    attempt = camera.attempt()
    result = PoseResult(0, 0, True, on_sphere(20, 30), None, 100, 120, 1.0)
    guess = camera.policy.next_guess(attempt, result)
    assert guess is not None
    assert camera.policy.next_guess(attempt.again(guess, 0), result) is None
    far = PoseResult(0, 1, True, on_sphere(40, 30), None, 100, 120, 1.0)
    assert camera.policy.next_guess(attempt.again(guess, 0), far) is None


def test_retries_try_a_keyframe_and_then_other_views() -> None:
    camera = tracking(retries=2)
    attempt, reasons = camera.attempt(), []
    failure = PoseResult(camera.frame_id, 0, False)
    while (guess := camera.policy.next_guess(attempt, failure)) is not None:
        reasons.append(guess.reason)
        attempt = attempt.again(guess, 0)
    assert reasons == [GuessReason.KEYFRAME, GuessReason.RELOCALISATION]
