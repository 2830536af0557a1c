"""Requests to tracking: it forgets and begins again, here or elsewhere, solves more or less often, and says so."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from support.analytic_scene import viewpoint
from support.followed import LENS, VIEW, grey_and_depth, photograph, pyramid_of
from support.tracking_world import CAMERA, MS, World, frame_info, hand_held, on_sphere, ring_of_views

from fieldpose.bus.codec import decode, encode
from fieldpose.bus.messages import CameraInfo, Control, GuessReason, Message, Reason, State, TrackingState
from fieldpose.bus.node import first_header
from fieldpose.bus.requests import ControlValues, Request, Reset, SetGuess, SetSolving, Show, TakeKeyframe
from fieldpose.bus.topics import CAMERA_INFO, CONTROL, STATE
from fieldpose.errors import RefusedError
from fieldpose.stages.following.config import FollowingConfig
from fieldpose.stages.geometry import exp_se3
from fieldpose.stages.nerf.training_views import TrainingViews
from fieldpose.stages.tracking.config import TrackingConfig
from fieldpose.stages.tracking.control import Controls
from fieldpose.stages.tracking.core import Counts, GuessOrder, LookOrder, StateReport, Tracker
from fieldpose.stages.tracking.followed import FollowedPolicy
from fieldpose.stages.tracking.following import FollowedReport, FollowingTracker
from fieldpose.stages.tracking.node import TrackingNode
from fieldpose.stages.tracking.photos import PhotoPolicy
from fieldpose.stages.tracking.policy import Alike, FrameInfo, PoseResult
from fieldpose.stages.tracking.priors import Priors
from fieldpose.stages.tracking.video import VideoPolicy

VIEWS = ring_of_views()
START, ELSEWHERE = on_sphere(3, 31), on_sphere(100, 20)
RING = np.stack([viewpoint(azimuth, elevation) for elevation in (15, 35, 55) for azimuth in range(0, 360, 30)])
FRAME_NS = 33 * MS
INITIALIZING, TRACKING = TrackingState.INITIALIZING, TrackingState.TRACKING


def video_tracker(start: np.ndarray | None = START, looks: bool = False, **config: object) -> Tracker:
    settings = TrackingConfig(**config)  # type: ignore[arg-type]
    return Tracker(settings, VideoPolicy(settings, VIEWS, Priors(), start, looks))


def consistent(counts: Counts) -> bool:
    return (
        counts.received == counts.admitted + counts.dropped_at_the_door + counts.waiting
        and counts.admitted == counts.finished + counts.lost + counts.in_flight
    )


def found(order: GuessOrder, pose: np.ndarray) -> PoseResult:
    covariance = np.diag([1e-5] * 3 + [1e-6] * 3)
    return PoseResult(order.frame.frame_id, order.pass_index, pose, covariance, 150, 200, 1.0)


def reports(said: Iterable[object]) -> list[StateReport]:
    return [each for each in said if isinstance(each, StateReport)]


def guesses(said: Iterable[object]) -> list[GuessOrder]:
    return [each for each in said if isinstance(each, GuessOrder)]


def settled(tracker: Tracker, path: Any, since: int = 0, count: int = 4) -> list[StateReport]:
    """Frames whose every pass finds the true pose at once."""
    believed: list[StateReport] = []
    for number in range(since, since + count):
        now_ns = number * FRAME_NS
        said = tracker.on_frame(frame_info(number, now_ns), now_ns)
        while said:
            believed += reports(said)
            said = [more for order in guesses(said) for more in tracker.on_result(found(order, path(number)), now_ns)]
    return believed


class TestVideo:
    """Where each frame that is admitted is solved."""

    def test_what_is_in_flight_and_what_waits_is_answered_and_late_results_change_nothing(self) -> None:
        tracker = video_tracker(depth=2)
        settled(tracker, lambda number: START)
        orders = [
            order
            for number in (4, 5, 6)
            for order in guesses(tracker.on_frame(frame_info(number, number * FRAME_NS), number * FRAME_NS))
        ]
        assert (tracker.counts.in_flight, tracker.counts.waiting) == (2, 1)
        said = tracker.restart(None, 7 * FRAME_NS)
        assert [(each.frame.frame_id, each.belief.state, each.belief.reason) for each in reports(said)] == [
            (number, INITIALIZING, Reason.RESET) for number in (4, 5, 6)
        ]
        assert len(reports(said)) == len(said)
        assert all(each.belief.cam_from_object is None for each in reports(said))
        counts = tracker.counts
        assert (counts.received, counts.finished, counts.lost, counts.dropped_at_the_door) == (7, 4, 2, 1)
        assert consistent(counts)
        for order in orders:
            assert tracker.on_result(found(order, ELSEWHERE), 8 * FRAME_NS) == []
        assert tracker.on_tick(10**12) == []
        assert (tracker.counts.late, tracker.counts.lost) == (2, 2)
        (first,) = guesses(tracker.on_frame(frame_info(9, 9 * FRAME_NS), 9 * FRAME_NS))
        assert first.guess.reason is GuessReason.PRIOR
        np.testing.assert_array_equal(first.guess.cam_from_object, START)

    def test_an_answer_to_a_look_that_comes_late_changes_nothing(self) -> None:
        tracker = video_tracker(None, looks=True)
        (look,) = tracker.on_frame(frame_info(0, 0), 0)
        assert isinstance(look, LookOrder)
        assert [each.belief.reason for each in reports(tracker.restart(None, 1))] == [Reason.RESET]
        assert tracker.on_alike(0, Alike([ELSEWHERE]), 2) == []
        assert isinstance(tracker.on_frame(frame_info(1, FRAME_NS), FRAME_NS)[0], LookOrder)
        assert consistent(tracker.counts)

    def test_it_behaves_as_one_that_has_just_begun(self) -> None:
        """With the same frames after it, whatever came before: the same orders and the same beliefs."""
        used, fresh = (video_tracker(None, depth=1) for _ in range(2))
        World(used, lambda t: None if 1 < t < 2 else hand_held(t)).run(3)
        used.restart(None, 3 * 10**9)
        used._latency_ms = None  # what is known of the pipeline stays
        worlds = [World(tracker, hand_held, seed=4).run(4) for tracker in (used, fresh)]
        orders = [[(o.frame.frame_id, o.pass_index, o.guess.reason) for o in world.guesses] for world in worlds]
        assert orders[0] == orders[1]
        assert len(worlds[0].reports) == len(worlds[1].reports) > 20
        for one, other in zip(worlds[0].reports, worlds[1].reports, strict=True):
            assert (one.frame, one.belief.state, one.belief.score) == (
                other.frame, other.belief.state, other.belief.score,
            )  # fmt: skip
            assert (one.belief.cam_from_object is None) == (other.belief.cam_from_object is None)
            if one.belief.cam_from_object is not None:
                np.testing.assert_array_equal(one.belief.cam_from_object, other.belief.cam_from_object)
        assert consistent(used.counts)

    def test_a_guess_is_where_it_begins_until_it_is_reset(self) -> None:
        tracker = video_tracker(None)
        settled(tracker, lambda number: START)
        assert tracker.begins_at is None
        tracker.restart(ELSEWHERE, 0)
        np.testing.assert_array_equal(tracker.begins_at, ELSEWHERE)
        believed = settled(tracker, lambda number: ELSEWHERE, 4)
        assert believed[-1].belief.state is TRACKING
        np.testing.assert_array_equal(believed[-1].belief.cam_from_object, ELSEWHERE)
        tracker.restart(None, 0)
        assert tracker.begins_at is None
        (order,) = guesses(tracker.on_frame(frame_info(20, 20 * FRAME_NS), 20 * FRAME_NS))
        assert order.guess.reason is GuessReason.RELOCALISATION

    def test_a_reset_begins_at_the_guess_that_the_run_was_given(self) -> None:
        tracker = video_tracker(START)
        tracker.restart(ELSEWHERE, 0)
        tracker.restart(None, 0)
        np.testing.assert_array_equal(tracker.begins_at, START)

    def test_a_guess_that_leads_nowhere_is_given_up_for_training_views(self) -> None:
        tracker = video_tracker(hand_held(0), depth=1)
        tracker.restart(on_sphere(180, -20), 0)
        world = World(tracker, hand_held).run(20)
        assert world.first_reasons()[0] is GuessReason.PRIOR
        assert world.states()[-1] is TRACKING

    @pytest.mark.parametrize("seed", range(4))
    def test_counts_hold_however_often_it_is_reset(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        tracker = video_tracker(depth=3)
        world = World(tracker, hand_held, loses=0.1, seed=seed, latency_ms=lambda rng: rng.uniform(60, 400))
        on_tick = tracker.on_tick

        def tick(now_ns: int) -> list[Any]:
            said = on_tick(now_ns)
            if rng.random() < 0.02:
                said = [*said, *tracker.restart(None if rng.random() < 0.5 else hand_held(now_ns * 1e-9), now_ns)]
            assert consistent(tracker.counts)
            return said

        tracker.on_tick = tick  # type: ignore[method-assign]
        world.run(6)
        answered = [report.frame.frame_id for report in world.reports]
        assert len(answered) == len(set(answered))
        assert TRACKING in world.states()


class Followed:
    """A tracker that follows frames of the analytic scene from a camera that stands still, solved by hand."""

    def __init__(self, start: np.ndarray | None, **following: object) -> None:
        config = FollowingConfig(**following)  # type: ignore[arg-type]
        views = TrainingViews(tuple(map(str, range(len(RING)))), RING)
        self.policy = FollowedPolicy(TrackingConfig(), config, views, Priors(), start)
        self.tracker = FollowingTracker(TrackingConfig(), config, self.policy)
        self.number = -1

    def frame(self, pose: np.ndarray) -> list[Any]:
        self.number += 1
        info = FrameInfo(self.number, self.number * FRAME_NS, LENS)
        return self.tracker.on_frame(info, pyramid_of(photograph(pose)), info.capture_ns)

    def solved(self, order: GuessOrder, pose: np.ndarray) -> list[Any]:
        at, now_ns = order.guess.cam_from_object, self.number * FRAME_NS
        view_id = f"{order.frame.frame_id}/{order.pass_index}"
        self.tracker.on_view(order.frame.frame_id, view_id, *grey_and_depth(at), VIEW, at, now_ns)
        return self.tracker.on_result(found(order, pose), now_ns)

    def begun(self, pose: np.ndarray) -> None:
        (order,) = guesses(self.frame(pose))
        self.solved(order, pose)
        assert reports(self.frame(pose))[0].belief.state is TRACKING


class TestFollowed:
    pose = viewpoint(20, 35)
    near = exp_se3([0, 0, 0, 0.01, 0.01, 0]) @ pose

    def test_it_does_not_go_on_from_the_old_pose_though_its_views_stay(self) -> None:
        video = Followed(self.near)
        video.begun(self.pose)
        remembered = len(video.policy.follower)
        assert remembered > 0
        assert video.tracker.restart(None, 0) == []
        assert len(video.policy.follower) == remembered
        said = video.frame(self.pose)
        (report,) = reports(said)
        assert (report.belief.state, report.belief.score) == (INITIALIZING, 0.0)
        assert report.belief.cam_from_object is None
        (order,) = guesses(said)
        assert order.guess.reason is GuessReason.PRIOR
        np.testing.assert_array_equal(order.guess.cam_from_object, self.near)
        video.solved(order, self.pose)
        assert reports(video.frame(self.pose))[0].belief.state is TRACKING

    def test_a_solve_that_was_under_way_changes_nothing(self) -> None:
        video = Followed(self.near)
        (order,) = guesses(video.frame(self.pose))
        video.tracker.restart(viewpoint(200, 35), 0)
        assert video.solved(order, self.pose) == []
        said = video.frame(self.pose)
        assert reports(said)[0].belief.state is INITIALIZING
        np.testing.assert_array_equal(guesses(said)[0].guess.cam_from_object, viewpoint(200, 35))
        counts = video.tracker.counts
        assert (counts.received, counts.finished, counts.lost) == (2, 2, 0)
        assert consistent(counts)
        assert consistent(video.tracker._solves.counts)

    def test_what_was_learnt_of_the_focal_length_is_forgotten(self) -> None:
        video = Followed(self.near)
        video.begun(self.pose)
        video.policy._focal.note(0.2, 1e-4)
        assert reports(video.frame(self.pose))[0].belief.reason is Reason.CAMERA_DIFFERS
        video.tracker.restart(None, 0)
        video.begun(self.pose)

    def test_frames_are_solved_as_often_as_is_asked_for(self) -> None:
        def solved_in(seconds: float) -> int:
            count = 0
            for _ in range(round(seconds * 1e9 / FRAME_NS)):
                for order in guesses(video.frame(self.pose)):
                    video.solved(order, self.pose)
                    count += 1
            return count

        video = Followed(self.near, fresh_deg=60.0)
        assert video.tracker.solves_per_s == 1.0
        video.begun(self.pose)
        video.tracker.solve_at_least(0.0)
        assert video.tracker.solves_per_s == 0.0
        assert solved_in(3.0) == 0
        video.tracker.solve_at_least(5.0)
        assert video.tracker.solves_per_s == 5.0
        assert 8 <= solved_in(2.0) <= 10
        assert Followed(self.near, solve_ms=0.0).tracker.solves_per_s == 100.0

    def test_a_keyframe_is_solved_at_once_from_where_it_was_followed_and_its_view_is_kept(self) -> None:
        video = Followed(self.near, fresh_deg=60.0, solve_ms=np.inf)
        video.begun(self.pose)
        assert guesses(video.frame(self.pose)) == []
        video.tracker.take_keyframe()
        (order,) = guesses(said := video.frame(self.pose))
        (measured,) = [each.followed for each in said if isinstance(each, FollowedReport)]
        np.testing.assert_array_equal(order.guess.cam_from_object, measured.cam_from_object)
        assert video.tracker.keyframes == 0
        video.solved(order, self.pose)
        assert video.tracker.keyframes == 1
        assert guesses(video.frame(self.pose)) == []
        video.tracker.restart(None, 0)
        assert video.tracker.keyframes == 1

    def test_a_keyframe_that_the_solve_does_not_bear_out_is_not_kept(self) -> None:
        video = Followed(self.near, fresh_deg=60.0, solve_ms=np.inf)
        video.begun(self.pose)
        video.tracker.take_keyframe()
        (order,) = guesses(video.frame(self.pose))
        video.solved(order, viewpoint(30, 35))
        assert video.tracker.keyframes == 0

    def test_a_keyframe_needs_a_track_and_is_forgotten_by_a_reset(self) -> None:
        video = Followed(self.near, fresh_deg=60.0, solve_ms=np.inf)
        with pytest.raises(RefusedError, match="not tracked"):
            video.tracker.take_keyframe()
        video.begun(self.pose)
        video.tracker.take_keyframe()
        video.tracker.restart(self.pose, 0)
        video.begun(self.pose)
        assert guesses(video.frame(self.pose)) == []
        assert video.tracker.keyframes == 0


PHOTOS_TAKE_NONE = [
    Reset(), SetGuess(cam_from_object=ELSEWHERE), SetSolving(solves_per_s=1.0), TakeKeyframe(),
]  # fmt: skip


class TestControls:
    def asked(self, tracker: Tracker | FollowingTracker, request: Request) -> tuple[ControlValues, list[Message]]:
        values, outputs = Controls(tracker).carry_out(request, 5)
        return values, [decode(encode(message), topic.message_type) for topic, message in outputs]

    def test_what_was_done_is_said(self) -> None:
        rough = ELSEWHERE + 1e-4
        rough[3] = (0, 0, 0, 1)
        values, (control,) = self.asked(video_tracker(), SetGuess(cam_from_object=rough))
        assert isinstance(control, Control)
        assert (control.request, control.after_frame, control.solves_per_s) == ("set_guess", None, None)
        assert control.header.capture_ns == 5
        np.testing.assert_allclose(control.cam_from_object, ELSEWHERE, atol=1e-3)
        np.testing.assert_array_equal(control.cam_from_object, values.begins_at)
        assert np.linalg.det(values.begins_at[:3, :3]) == pytest.approx(1, abs=1e-9)
        assert (values.state, values.requests, values.solves_per_s) == (INITIALIZING, 1, None)
        _, (control,) = self.asked(Followed(None).tracker, SetSolving(solves_per_s=4.0))
        assert (control.request, control.solves_per_s, control.cam_from_object) == ("set_solving", 4.0, None)

    def test_showing_says_nothing_on_the_bus(self) -> None:
        values, said = self.asked(Followed(None).tracker, Show())
        assert said == []
        assert (values.state, values.frames, values.requests, values.solves_per_s) == (INITIALIZING, 0, 0, 1.0)
        assert values.begins_at is None

    @pytest.mark.parametrize("request_", PHOTOS_TAKE_NONE)
    def test_photos_take_none_of_it(self, request_: Request) -> None:
        settings = TrackingConfig()
        tracker = Tracker(settings, PhotoPolicy(settings, VIEWS, Priors(), START))
        tracker.on_frame(frame_info(0, 0), 0)
        before, controls = tracker.counts, Controls(tracker)
        with pytest.raises(RefusedError, match="here"):
            controls.carry_out(request_, 0)
        assert tracker.counts == before
        assert controls.carry_out(Show(), 0)[0].requests == 0

    def test_where_frames_are_not_followed_there_is_no_rate(self) -> None:
        for request in (SetSolving(solves_per_s=1.0), TakeKeyframe()):
            with pytest.raises(RefusedError, match="frames are not followed here"):
                Controls(video_tracker()).carry_out(request, 0)

    def test_a_keyframe_that_is_taken_is_said(self) -> None:
        video = Followed(TestFollowed.near)
        video.begun(TestFollowed.pose)
        values, (control,) = self.asked(video.tracker, TakeKeyframe())
        assert isinstance(control, Control)
        assert (control.request, values.keyframes, values.requests) == ("take_keyframe", 0, 1)


def test_the_node_says_what_it_did_and_how_the_frames_ended_that_it_forgot() -> None:
    node = TrackingNode(video_tracker)
    node.start()

    def info(number: int) -> CameraInfo:
        return CameraInfo(header=first_header(number, number * FRAME_NS), camera=CAMERA)

    for number in (7, 8):
        list(node.handle(CAMERA_INFO, info(number)))
    assert node.control(Show(), 9 * FRAME_NS)[0].frames == 2
    values, outputs = node.control(Reset(), 9 * FRAME_NS)
    assert (values.state, values.requests) == (INITIALIZING, 1)
    (control_topic, control), *states = list(outputs)
    assert control_topic is CONTROL
    assert isinstance(control, Control)
    assert (control.request, control.after_frame) == ("reset", 8)
    assert [topic for topic, _ in states] == [STATE, STATE]
    for number, (_, state) in zip((7, 8), states, strict=True):
        assert isinstance(state, State)
        assert (state.header.frame_id, state.state, state.reason) == (number, INITIALIZING, Reason.RESET)
    assert state.lost + state.finished + state.in_flight == state.admitted
