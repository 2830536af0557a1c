"""The policy for videos step by step: which step follows from what, and which poses are believed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from support.tracking_world import MS, frame_info, on_sphere, ring_of_views

from fieldpose.bus.messages import GuessReason, Reason, TrackingState
from fieldpose.errors import ConfigError
from fieldpose.stages.geometry import Limit, rotation_error_deg
from fieldpose.stages.nerf.training_views import TrainingViews
from fieldpose.stages.tracking.config import TrackingConfig
from fieldpose.stages.tracking.policy import Alike, Attempt, Belief, FrameInfo, Look, PoseGuess, PoseResult, Step
from fieldpose.stages.tracking.priors import Priors
from fieldpose.stages.tracking.video import VideoPolicy

VIEWS = ring_of_views()
START = on_sphere(0, 30)


class Camera:
    """Hands frames to a policy every 50 ms, one after another, and the results that a test wants.

    alike: what every Look is answered with.
    """

    def __init__(
        self, start: np.ndarray | None = START, looks: bool = False, awaited: bool = False, **config: object
    ) -> None:
        priors = Priors(awaited)
        self.policy = VideoPolicy(TrackingConfig(**config), VIEWS, priors, start, looks)  # type: ignore[arg-type]
        self.frame_id = -1
        self.alike: Sequence[np.ndarray] = ()

    def frame(self, skip: int = 0) -> FrameInfo:
        self.frame_id += 1 + skip
        return frame_info(self.frame_id, self.frame_id * 50 * MS)

    def step(self) -> Step | None:
        return self.policy.first_step(self.frame())

    def attempt(self, skip: int = 0) -> Attempt:
        """The next frame, on its first pass."""
        attempt = Attempt(self.frame(skip), 0)
        step = self.policy.first_step(attempt.frame)
        if isinstance(step, Look):
            step = self.policy.after_look(attempt, Alike(self.alike))
        assert isinstance(step, PoseGuess)
        return attempt.again(step, 0)

    def guess(self, skip: int = 0) -> PoseGuess:
        return guess_of(self.attempt(skip))

    def conclude(self, attempt: Attempt, pose: np.ndarray | None, inliers: int = 100) -> Belief:
        """The belief after a result that is asked no further pass for."""
        reason = Reason.TOO_FEW_MATCHES if pose is None else None
        result = PoseResult(attempt.frame.frame_id, 0, pose, None, inliers, 120, 1.0, reason)
        return self.policy.conclude(attempt, result)

    def see(self, pose: np.ndarray | None, inliers: int = 100, skip: int = 0) -> Belief:
        return self.conclude(self.attempt(skip), pose, inliers)

    def lose(self) -> None:
        while self.see(None).state is not TrackingState.LOST:
            pass


def guess_of(attempt: Attempt) -> PoseGuess:
    assert attempt.guess is not None
    return attempt.guess


def tracking(**config: object) -> Camera:
    """After ten frames along a circle, one degree a frame; the last at 9 degrees."""
    camera = Camera(**config)  # type: ignore[arg-type]
    for i in range(10):
        assert camera.see(on_sphere(i, 30)).state is TrackingState.TRACKING
    return camera


def found(pose: np.ndarray, attempt: Attempt) -> PoseResult:
    return PoseResult(attempt.frame.frame_id, attempt.pass_index, pose, None, 100, 120, 1.0)


def failed(attempt: Attempt) -> PoseResult:
    return PoseResult(attempt.frame.frame_id, attempt.pass_index, reason=Reason.NO_CONSENSUS)


def is_view(pose: np.ndarray) -> bool:
    return any(np.array_equal(pose, view) for view in VIEWS.cam_from_object)


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
    guess = tracking().guess(skip=30)
    assert guess.reason is GuessReason.KEYFRAME
    np.testing.assert_array_equal(guess.cam_from_object, on_sphere(9, 30))


def test_a_prior_is_the_guess_of_its_frame_alone() -> None:
    camera = tracking()
    camera.policy.on_prior(11, prior := on_sphere(70, 20))
    assert camera.guess().reason is GuessReason.MOTION
    guess = camera.guess()
    assert (guess.reason, guess.cam_from_object is prior) == (GuessReason.PRIOR, True)
    assert camera.guess().reason is GuessReason.MOTION


def test_a_jump_waits_for_a_second_frame_and_then_begins_a_new_motion() -> None:
    camera = tracking(jump_per_s=Limit(10, 1))
    first = camera.see(on_sphere(60, 30))
    assert first.state is TrackingState.LIMITED
    assert first.reason is Reason.IMPLAUSIBLE_POSE
    assert rotation_error_deg(first.cam_from_object, on_sphere(10, 30)) < 1
    second = camera.see(on_sphere(60, 30))
    assert (second.state, second.reason) == (TrackingState.TRACKING, None)
    np.testing.assert_array_equal(second.cam_from_object, on_sphere(60, 30))
    guess = camera.guess()
    assert guess.reason is GuessReason.MOTION
    assert rotation_error_deg(guess.cam_from_object, on_sphere(60, 30)) < 1e-6


def test_two_jumps_to_different_places_confirm_nothing() -> None:
    camera = tracking(jump_per_s=Limit(10, 1))
    assert camera.see(on_sphere(60, 30)).state is TrackingState.LIMITED
    assert camera.see(on_sphere(120, 30)).state is TrackingState.LIMITED
    assert camera.see(on_sphere(12, 30)).state is TrackingState.TRACKING


def test_a_jump_is_forgotten_once_the_track_goes_on() -> None:
    camera = tracking(jump_per_s=Limit(10, 1))
    camera.see(on_sphere(60, 30))
    assert camera.see(on_sphere(11, 30)).state is TrackingState.TRACKING
    assert camera.see(on_sphere(60, 30)).state is TrackingState.LIMITED


def test_what_was_under_way_before_a_recovery_is_not_held_against_it() -> None:
    camera = tracking()
    camera.lose()
    stray = camera.attempt()
    recovering = camera.attempt()
    belief = camera.conclude(recovering, guess_of(recovering).cam_from_object)
    assert belief.state is TrackingState.TRACKING
    assert camera.conclude(stray, None).state is TrackingState.TRACKING
    assert camera.see(None).state is TrackingState.LIMITED


@pytest.mark.parametrize("start", [None, START], ids=["no start", "start"])
def test_nothing_is_rendered_before_a_look_while_there_is_no_track(start: np.ndarray | None) -> None:
    camera = Camera(start, looks=True, lost_after=2)
    if start is not None:
        assert [camera.guess().reason for _ in range(3)] == [GuessReason.PRIOR] * 3
        camera.lose()
    attempt = Attempt(camera.frame(), 0)
    assert camera.policy.first_step(attempt.frame) == Look()
    guess = camera.policy.after_look(attempt, Alike([alike := on_sphere(77, 20)]))
    assert guess is not None
    assert (guess.reason, guess.cam_from_object is alike) == (GuessReason.RELOCALISATION, True)


def test_a_track_asks_no_look() -> None:
    camera = tracking(looks=True)
    assert isinstance(camera.step(), PoseGuess)
    camera.see(None)
    assert isinstance(camera.step(), PoseGuess)


def test_a_pose_that_waits_to_be_confirmed_needs_no_look() -> None:
    camera = tracking(looks=True)
    camera.lose()
    camera.see(pose := on_sphere(140, 30))
    step = camera.step()
    assert isinstance(step, PoseGuess)
    assert (step.reason, step.cam_from_object is pose) == (GuessReason.RELOCALISATION, True)
    assert camera.step() == Look()


@pytest.mark.parametrize("reason", [None, Reason.NOTHING_ALIKE, Reason.NOT_AVAILABLE, Reason.NO_ANSWER])
def test_where_nothing_looks_like_a_frame_other_poses_are_tried(reason: Reason | None) -> None:
    camera = tracking(looks=True)
    camera.lose()
    guesses = []
    for _ in range(4):
        guess = camera.policy.after_look(Attempt(camera.frame(), 0), Alike(reason=reason))
        assert guess is not None
        guesses.append(guess.cam_from_object)
    np.testing.assert_array_equal(guesses[0], on_sphere(9, 30))
    assert all(is_view(guess) for guess in guesses[1::2])


def test_a_lost_video_goes_on_from_what_looks_like_its_frames() -> None:
    camera = tracking(looks=True)
    camera.lose()
    camera.alike = [on_sphere(77, 20), on_sphere(80, 20)]
    attempt = camera.attempt()
    assert guess_of(attempt).cam_from_object is camera.alike[0]
    elsewhere = camera.policy.next_step(attempt, failed(attempt))
    assert isinstance(elsewhere, PoseGuess)
    assert not any(elsewhere.cam_from_object is pose for pose in camera.alike)
    second = camera.attempt()
    assert guess_of(second).cam_from_object is camera.alike[1]
    camera.alike = [on_sphere(90, 20)]
    assert camera.guess().cam_from_object is camera.alike[0]


def test_a_retry_of_a_frame_knows_what_looks_like_it_and_not_what_looks_like_another() -> None:
    camera = tracking(looks=True)
    camera.lose()
    camera.alike = [on_sphere(70, 20), on_sphere(75, 20)]
    first = camera.attempt()
    camera.alike = [on_sphere(80, 20), on_sphere(85, 20)]
    second = camera.attempt()
    retries = []
    for attempt in (second, first):
        retry = camera.policy.next_step(attempt, failed(attempt))
        assert isinstance(retry, PoseGuess)
        retries.append(retry.cam_from_object)
    assert not any(retries[1] is pose for pose in camera.alike)


def test_a_loss_is_followed_by_the_last_pose_and_by_training_views() -> None:
    camera = tracking()
    camera.lose()
    guesses = [camera.guess() for _ in range(4)]
    assert {guess.reason for guess in guesses} == {GuessReason.RELOCALISATION}
    np.testing.assert_array_equal(guesses[0].cam_from_object, on_sphere(9, 30))
    assert all(is_view(guess.cam_from_object) for guess in guesses[1::2])


def test_a_pose_far_from_its_guess_is_tried_as_the_next_guess() -> None:
    camera = tracking()
    camera.lose()
    attempt = camera.attempt()
    assert camera.conclude(attempt, pose := on_sphere(40, 30)).state is TrackingState.LOST
    again = camera.attempt()
    assert guess_of(again).cam_from_object is pose
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
    assert (belief.state, belief.score, belief.reason) == (TrackingState.LIMITED, 0.0, Reason.IMPLAUSIBLE_POSE)


def test_a_failure_is_reported_with_its_reason() -> None:
    camera = tracking()
    assert camera.see(None).reason is Reason.TOO_FEW_MATCHES
    assert camera.see(on_sphere(11, 30)).reason is None


def test_lost_messages_limit_the_track_only_after_the_horizon() -> None:
    camera = tracking()
    soon = camera.policy.missed(frame_info(12, 600 * MS), Reason.NO_ANSWER)
    assert (soon.state, soon.reason) == (TrackingState.TRACKING, Reason.NO_ANSWER)
    assert soon.cam_from_object is not None
    late = camera.policy.missed(frame_info(99, 5_000 * MS), Reason.NO_ANSWER)
    assert (late.state, late.cam_from_object) == (TrackingState.LIMITED, None)


def test_a_start_that_does_not_work_out_is_given_up() -> None:
    camera = Camera(lost_after=3)
    reasons = []
    for _ in range(5):
        attempt = camera.attempt()
        reasons.append(guess_of(attempt).reason)
        camera.conclude(attempt, None)
    assert reasons == [GuessReason.PRIOR] * 3 + [GuessReason.RELOCALISATION] * 2


@pytest.mark.parametrize("looks", [False, True])
def test_without_any_pose_to_begin_with_it_says_so(looks: bool) -> None:
    nothing = TrainingViews((), np.zeros((0, 4, 4)))
    with pytest.raises(ConfigError, match="--guess"):
        VideoPolicy(TrackingConfig(), nothing, Priors(), None, looks)


@pytest.mark.parametrize(("moved_deg", "expected"), [(0.1, None), (20, GuessReason.NEXT_PASS)])
def test_another_pass_is_asked_for_where_the_pose_moved(moved_deg: float, expected: GuessReason | None) -> None:
    camera = Camera()
    attempt = camera.attempt()
    step = camera.policy.next_step(attempt, found(on_sphere(moved_deg, 30), attempt))
    assert (step.reason if isinstance(step, PoseGuess) else step) is expected


def test_a_track_takes_a_pose_near_its_motion_without_another_pass() -> None:
    camera = tracking()
    attempt = camera.attempt()
    near, far = (found(on_sphere(azimuth, 30), attempt) for azimuth in (13, 40))
    assert camera.policy.next_step(attempt, near) is None
    assert camera.policy.next_step(attempt, far) is not None


def test_no_more_passes_than_configured() -> None:
    camera = Camera(passes=2)
    attempt = camera.attempt()
    result = found(on_sphere(20, 30), attempt)
    guess = camera.policy.next_step(attempt, result)
    assert isinstance(guess, PoseGuess)
    again = attempt.again(guess, 0)
    assert camera.policy.next_step(again, result) is None
    assert camera.policy.next_step(again, found(on_sphere(40, 30), again)) is None


def test_retries_try_a_keyframe_and_then_other_views() -> None:
    camera = tracking(retries=2)
    attempt, reasons = camera.attempt(), []
    while (step := camera.policy.next_step(attempt, failed(attempt))) is not None:
        assert isinstance(step, PoseGuess)
        reasons.append(step.reason)
        attempt = attempt.again(step, 0)
    assert reasons == [GuessReason.KEYFRAME, GuessReason.RELOCALISATION]
