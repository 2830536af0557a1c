"""Videos whose every frame is followed, with solves that come late: a scene of known geometry, driven by hand."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from support.analytic_scene import viewpoint
from support.followed import LENS, VIEW, grey_and_depth, photograph, pyramid_of

from fieldpose.bus.messages import GuessReason, Reason, TrackingState
from fieldpose.stages.following.config import POINTS_BY_LEVEL, FollowingConfig
from fieldpose.stages.geometry import Limit, exp_se3, rotation_error_deg, translation_error
from fieldpose.stages.nerf.training_views import TrainingViews
from fieldpose.stages.tracking.config import TrackingConfig
from fieldpose.stages.tracking.core import GuessOrder, LookOrder, Output, StateReport
from fieldpose.stages.tracking.followed import FollowedPolicy
from fieldpose.stages.tracking.following import FollowedReport, FollowingTracker
from fieldpose.stages.tracking.policy import Alike, FrameInfo, PoseResult
from fieldpose.stages.tracking.priors import Priors

MS = 1_000_000
FRAME_MS = 33
VIEW_AFTER, SOLVE_AFTER = 2, 4
"""Frames that come meanwhile."""
LOST_AFTER = 5
ELSEWHERE = exp_se3([0, 0, 0, 0.2, 0.2, 0])
"""A turn of 16 degrees, after which nothing is where it was."""
INITIALIZING, TRACKING, LIMITED, LOST = (
    TrackingState.INITIALIZING, TrackingState.TRACKING, TrackingState.LIMITED, TrackingState.LOST,
)  # fmt: skip
RING = np.stack([viewpoint(azimuth, elevation) for elevation in (15, 35, 55) for azimuth in range(0, 360, 30)])


def truth(number: float) -> np.ndarray:
    """Half a degree a frame."""
    return viewpoint(20 + 0.5 * number, 35 + 0.2 * number)


def covered(grey: np.ndarray) -> np.ndarray:
    """All but its top, by which it can be followed badly."""
    hidden = grey.copy()
    hidden[80:] = 90
    return hidden


class Video:
    """Frames of a moving camera, and solves that end some frames after they were asked for.

    A solve finds the true pose, a little disturbed and times `solves_off`, if its guess is within 15 degrees and the
    frame is not black.
    """

    def __init__(self, start: np.ndarray | None = None, **following: object) -> None:
        config = FollowingConfig(**{"lost_after": LOST_AFTER, **following})  # type: ignore[arg-type]
        views = TrainingViews(tuple(map(str, range(len(RING)))), RING)
        self.policy = FollowedPolicy(TrackingConfig(), config, views, Priors(), start)
        self.tracker = FollowingTracker(TrackingConfig(), config, self.policy)
        self.number = -1
        self.solves_off = np.eye(4)
        self.reports: list[StateReport] = []
        self.measured: list[FollowedReport] = []
        self.guesses: list[GuessOrder] = []
        self.solved = 0
        self._black: set[int] = set()
        self._due: list[tuple[int, Callable[[int], list[Output | FollowedReport]]]] = []

    @property
    def now_ns(self) -> int:
        return self.number * FRAME_MS * MS

    def play(
        self, count: int = 1, edit: Callable[[np.ndarray], np.ndarray] = lambda grey: grey, readable: bool = True
    ) -> list[StateReport]:
        """So many frames more; what is believed of each."""
        for _ in range(count):
            self.number += 1
            for due in [due for due in self._due if due[0] <= self.number]:
                self._due.remove(due)
                self._take(due[1](self.now_ns))
            self._take(self.tracker.on_tick(self.now_ns))
            grey = edit(photograph(truth(self.number)))
            if not readable or grey.max() == 0:
                self._black.add(self.number)
            frame = FrameInfo(self.number, self.now_ns, LENS)
            self.feed(frame, grey if readable else None)
        return self.reports[-count:]

    def feed(self, frame: FrameInfo, grey: np.ndarray | None) -> StateReport:
        """Exactly one report comes of a frame."""
        before = len(self.reports)
        self._take(self.tracker.on_frame(frame, None if grey is None else pyramid_of(grey), self.now_ns))
        assert [report.frame for report in self.reports[before:]] == [frame]
        return self.reports[-1]

    def black(self, count: int = 1) -> list[StateReport]:
        return self.play(count, np.zeros_like)

    def follow_well(self, count: int = 12) -> Video:
        """Play so many frames from a start at which all goes well."""
        self.play(count)
        assert self.reports[-1].belief.state is TRACKING
        return self

    def solve_twice(self, **how: Callable[[np.ndarray], np.ndarray]) -> None:
        """Play until two solves more have ended."""
        for _ in range(2):
            self.solve_once(**how)

    def solve_once(self, **how: Callable[[np.ndarray], np.ndarray]) -> None:
        """Play until a solve more has ended; the newest frame is the first after that."""
        before = self.solved
        while self.solved == before:
            assert self.number < 200
            self.play(1, **how)  # type: ignore[arg-type]

    def _take(self, outputs: list[Output | FollowedReport]) -> None:
        for output in outputs:
            match output:
                case StateReport():
                    self.reports.append(output)
                case FollowedReport():
                    self.measured.append(output)
                case LookOrder():
                    answer = partial(self.tracker.on_alike, output.frame.frame_id, Alike([RING[13]]))
                    self._due.append((self.number + 1, answer))
                case GuessOrder():
                    self.guesses.append(output)
                    self._due.append((self.number + VIEW_AFTER, partial(self._view, output)))
                    self._due.append((self.number + SOLVE_AFTER, partial(self._solve, output)))

    def _view(self, order: GuessOrder, now_ns: int) -> list[Output | FollowedReport]:
        frame_id, pose = order.frame.frame_id, order.guess.cam_from_object
        view_id = f"{frame_id}/{order.pass_index}"
        self.tracker.on_view(frame_id, view_id, *grey_and_depth(pose), VIEW, pose, now_ns)
        return []

    def _solve(self, order: GuessOrder, now_ns: int) -> list[Output | FollowedReport]:
        self.solved += 1
        ids, pose = (order.frame.frame_id, order.pass_index), truth(order.frame.frame_id)
        if order.frame.frame_id in self._black or rotation_error_deg(order.guess.cam_from_object, pose) > 15:
            return self.tracker.on_result(PoseResult(*ids, reason=Reason.NO_CONSENSUS), now_ns)
        found = self.solves_off @ exp_se3([0.004, -0.003, 0.005, 0.001, 0.001, -0.001]) @ pose
        return self.tracker.on_result(PoseResult(*ids, found, np.diag([1e-5] * 3 + [1e-6] * 3), 150, 200, 1.0), now_ns)


def assert_right(reports: list[StateReport], angle_deg: float = 0.1, distance: float = 0.01) -> None:
    """Measured, and where the camera was."""
    for report in reports:
        pose, at = report.belief.cam_from_object, truth(report.frame.capture_ns / MS / FRAME_MS)
        assert report.belief.state is TRACKING
        assert report.belief.score > 0.4
        assert rotation_error_deg(pose, at) < angle_deg
        assert translation_error(pose, at) < distance


@pytest.fixture
def video() -> Video:
    """Begun near the first frame's pose."""
    return Video(viewpoint(22.0, 33.0))


def test_tracking_begins_with_the_first_solve_however_late_it_is(video: Video) -> None:
    """It is carried on to the newest frame, so that the one after that has its pose."""
    reports = video.play(20)
    states = [report.belief.state for report in reports]
    began = states.index(TRACKING)
    assert states == [INITIALIZING] * began + [TRACKING] * (20 - began)
    assert began == SOLVE_AFTER
    assert all(report.belief.score == 0 and report.belief.cam_from_object is None for report in reports[:began])
    assert_right(reports[began:])
    assert all(report.belief.covariance is not None for report in reports[began:])


def test_every_frame_has_one_answer_and_is_counted_once(video: Video) -> None:
    video.play(15)
    assert [report.frame.frame_id for report in video.reports] == list(range(15))
    video.tracker.on_frame(FrameInfo(20, 20 * FRAME_MS * MS, LENS), None, video.now_ns, missed=5)
    counts = video.tracker.counts
    assert (counts.received, counts.admitted, counts.finished, counts.dropped_at_the_door, counts.lost) == (
        21, 16, 16, 5, 0,
    )  # fmt: skip
    frames = {report.frame.frame_id for report in video.measured}
    assert frames == {report.frame.frame_id for report in video.reports if report.belief.score > 0}


def test_without_a_start_views_that_look_like_the_frame_are_tried() -> None:
    video = Video()
    reports = video.play(16)
    assert video.guesses[0].guess.reason is GuessReason.RELOCALISATION
    assert_right(reports[-8:])


def test_what_is_well_followed_is_seldom_solved() -> None:
    """Where the camera stays near what views have seen, and it is not long ago that it was solved."""
    video = Video(truth(0), fresh_deg=60.0, solve_ms=500.0)
    video.play(40)
    frames = [order.frame.frame_id for order in video.guesses]
    assert frames[0] == 0
    assert 2 <= len(frames) <= 4
    assert (np.diff(frames) * FRAME_MS >= 500).all()


def test_a_view_is_asked_for_before_the_camera_sees_what_none_has_seen() -> None:
    video = Video(truth(0), fresh_deg=3.0, solve_ms=60_000.0)
    assert_right(video.play(40)[SOLVE_AFTER:])
    asked = [order for order in video.guesses if order.guess.reason is GuessReason.MOTION]
    assert len(asked) > 2
    for order in asked[1:]:
        to_go = rotation_error_deg(order.guess.cam_from_object, truth(60))
        assert to_go < rotation_error_deg(truth(order.frame.frame_id), truth(60)) - 0.1


def test_frames_without_anything_limit_tracking_and_then_lose_it(video: Video) -> None:
    reports = video.follow_well().black(LOST_AFTER + 1)
    assert [report.belief.score for report in reports] == [0.0] * (LOST_AFTER + 1)
    states = [report.belief.state for report in reports]
    assert states == [LIMITED] * (LOST_AFTER - 1) + [LOST] * 2
    assert all(report.belief.reason is Reason.NO_CONSENSUS for report in reports)
    assert reports[0].belief.cam_from_object is not None
    assert reports[-1].belief.cam_from_object is None


def test_after_a_short_darkness_tracking_goes_on_where_the_camera_has_got_to(video: Video) -> None:
    video.follow_well().black(3)
    assert_right(video.play(4))


def test_what_was_lost_is_found_again_at_once_near_where_it_was(video: Video) -> None:
    assert video.follow_well().black(LOST_AFTER + 2)[-1].belief.state is LOST
    solves = video.solved
    assert_right(video.play(1))
    assert video.solved - solves <= 1
    assert_right(video.play(8))


def test_frames_that_show_little_are_followed_and_limit_tracking_late(video: Video) -> None:
    """A weak pose is a small strike; good ones take all back."""
    reports = video.follow_well().play(6, covered)
    assert all(0.2 < report.belief.score < 0.5 for report in reports)
    assert all(
        rotation_error_deg(report.belief.cam_from_object, truth(report.frame.frame_id)) < 0.5 for report in reports
    )
    assert reports[-1].belief.state in (TRACKING, LIMITED)
    assert_right(video.play(2))


def test_one_solve_that_contradicts_good_following_changes_nothing(video: Video) -> None:
    video.follow_well()
    video.solves_off = ELSEWHERE
    video.solve_once()
    video.solves_off = np.eye(4)
    assert_right(video.play(8))
    assert_right(video.reports[SOLVE_AFTER:])


def test_two_solves_that_agree_on_another_pose_replace_what_was_followed(video: Video) -> None:
    video.follow_well()
    video.solves_off = ELSEWHERE
    video.solve_twice()
    newest = video.reports[-1]
    assert newest.belief.score == 0
    assert rotation_error_deg(newest.belief.cam_from_object, ELSEWHERE @ truth(newest.frame.frame_id)) < 6


def test_two_solves_that_contradict_each_other_do_not() -> None:
    video = Video(truth(0), fresh_deg=0.0, solve_ms=0.0).follow_well()
    for turn in (0.2, -0.2, 0.2, -0.2):
        video.solves_off = exp_se3([0, 0, 0, turn, -turn, 0])
        video.solve_once()
    assert_right(video.reports[SOLVE_AFTER:])


def test_one_solve_replaces_what_is_badly_followed(video: Video) -> None:
    video.follow_well()
    video.play(SOLVE_AFTER + 1, covered)
    video.solves_off = ELSEWHERE
    video.solve_once(edit=covered)
    newest = video.reports[-1]
    assert newest.belief.score == 0
    assert rotation_error_deg(newest.belief.cam_from_object, ELSEWHERE @ truth(newest.frame.frame_id)) < 6


def test_a_solve_that_finds_nothing_or_never_ends_changes_nothing(video: Video) -> None:
    video.follow_well()
    for order in [video.guesses[-1]] * 2:
        result = PoseResult(order.frame.frame_id, order.pass_index, reason=Reason.NO_CONSENSUS)
        assert all(not isinstance(output, StateReport) for output in video.tracker.on_result(result, video.now_ns))
    assert_right(video.play(2))
    video.tracker.on_tick(video.now_ns + 60_000 * MS)
    assert_right(video.play(8))


def test_an_unreadable_frame_is_told_as_such(video: Video) -> None:
    (first,) = video.play(1, readable=False)
    assert (first.belief.state, first.belief.reason) == (INITIALIZING, Reason.FRAME_UNREADABLE)
    video.follow_well(14)
    (report,) = video.play(1, readable=False)
    assert (report.belief.score, report.belief.reason) == (0.0, Reason.FRAME_UNREADABLE)
    assert rotation_error_deg(report.belief.cam_from_object, truth(report.frame.frame_id)) < 0.5
    assert_right(video.play(2))


def test_frames_in_exchanged_order_and_of_equal_times_have_their_poses(video: Video) -> None:
    video.follow_well()
    for later, number in ((1, 14), (2, 13), (3, 16), (4, 15), (5, 17), (6, 17), (7, 18)):
        grey = photograph(truth(number))
        assert_right([video.feed(FrameInfo(100 + later, number * FRAME_MS * MS, LENS), grey)])


def test_a_prior_says_where_to_look_after_a_jump(video: Video) -> None:
    """Too far for the motion, and near for a prior of that frame; where one comes too late the solve is for it."""
    video.follow_well().black(LOST_AFTER + 2)
    video.number += 40
    prior = exp_se3([0, 0, 0, 0.01, 0, 0]) @ truth(video.number + 1)
    assert rotation_error_deg(prior, truth(video.number - 40)) > 15
    video.tracker.on_prior(video.number + 1, prior, video.now_ns)
    grey, depth = grey_and_depth(prior)
    video.policy.follower.add("there", grey, depth, VIEW, prior)
    assert_right(video.play(1))


def test_where_following_takes_too_long_less_is_done_until_it_is_quick_again(video: Video) -> None:
    video.follow_well()
    for _ in range(40):
        video.tracker.took(10.0 * FRAME_MS)
    (slow,) = video.play(1)
    assert slow.level == len(POINTS_BY_LEVEL) - 1
    assert len(video.measured[-1].followed.found) <= POINTS_BY_LEVEL[-1]
    assert_right([slow], 0.3, 0.03)
    for _ in range(40):
        video.tracker.took(0.01 * FRAME_MS)
    (quick,) = video.play(1)
    assert quick.level == 0
    assert len(video.measured[-1].followed.found) > POINTS_BY_LEVEL[1]


def test_one_slow_frame_changes_little_and_what_fits_nothing(video: Video) -> None:
    video.follow_well()
    for _ in range(40):
        video.tracker.took(0.8 * FollowingConfig().budget * FRAME_MS)
    assert video.play(1)[0].level == 0
    video.tracker.took(20.0 * FRAME_MS)
    assert video.play(1)[0].level == 1


def test_before_the_second_frame_nothing_is_known_of_the_time_there_is(video: Video) -> None:
    video.play(1)
    video.tracker.took(1e6)
    assert video.play(1)[0].level == 0


def test_how_late_views_come_is_learnt(video: Video) -> None:
    video.play(40)
    assert 0.3 * VIEW_AFTER * FRAME_MS < video.policy.ahead_ms <= VIEW_AFTER * FRAME_MS


def test_the_limit_of_what_speaks_against_following_is_a_setting() -> None:
    video = Video(truth(0), same=Limit(40.0, 10.0), fresh_deg=0.0, solve_ms=0.0).follow_well()
    video.solves_off = ELSEWHERE
    video.solve_twice()
    video.solve_twice()
    assert_right(video.reports[SOLVE_AFTER:])


def patient() -> FollowingTracker:
    views = TrainingViews(tuple(map(str, range(len(RING)))), RING)
    policy = FollowedPolicy(TrackingConfig(), FollowingConfig(), views, Priors(), viewpoint(22.0, 33.0), looks=False)
    return FollowingTracker(TrackingConfig(), FollowingConfig(), policy, patient=True)


class TestAPatientTracker:
    """For a source that waits for answers: a frame that is being solved is answered after that."""

    def play(self, count: int, took_ms: float, delay_ms: int) -> tuple[list[StateReport], list[int]]:
        """What is believed of each frame, and how many solves there were before its answer."""
        tracker, reports, solves = patient(), [], []
        for number in range(count):
            now_ns = number * FRAME_MS * MS
            said = tracker.on_frame(FrameInfo(number, now_ns, LENS), pyramid_of(photograph(truth(number))), now_ns)
            tracker.took(took_ms)
            solves.append(0)
            while not any(isinstance(one, StateReport) for one in said):
                (order,) = [one for one in said if isinstance(one, GuessOrder)]
                solves[-1] += 1
                now_ns += delay_ms * MS
                pose, true = order.guess.cam_from_object, truth(number)
                tracker.on_view(number, f"{number}/{order.pass_index}", *grey_and_depth(pose), VIEW, pose, now_ns)
                covariance = np.diag([1e-5] * 3 + [1e-6] * 3)
                said = tracker.on_result(PoseResult(number, order.pass_index, true, covariance, 150, 200, 1.0), now_ns)
            (report,) = [one for one in said if isinstance(one, StateReport)]
            assert report.frame.frame_id == number
            reports.append(report)
        return reports, solves

    def test_the_first_frame_has_the_pose_of_its_solve(self) -> None:
        reports, solves = self.play(1, took_ms=1.0, delay_ms=10)
        assert solves[0] > 0
        assert_right(reports)

    def test_nothing_depends_on_how_long_anything_takes(self) -> None:
        quick, slow = self.play(15, took_ms=1.0, delay_ms=1), self.play(15, took_ms=500.0, delay_ms=900)
        for one, other in zip(quick[0], slow[0], strict=True):
            assert one.belief.cam_from_object is not None
            assert other.belief.cam_from_object is not None
            np.testing.assert_array_equal(one.belief.cam_from_object, other.belief.cam_from_object)
            assert (one.belief.state, one.level) == (other.belief.state, other.level)
        assert quick[1] == slow[1]

    def test_a_reset_answers_the_frame_that_is_being_solved(self) -> None:
        tracker = patient()
        said = tracker.on_frame(FrameInfo(0, 0, LENS), pyramid_of(photograph(truth(0))), 0)
        assert [type(one) for one in said] == [GuessOrder]
        assert [one.frame.frame_id for one in tracker.restart(None, 1) if isinstance(one, StateReport)] == [0]
