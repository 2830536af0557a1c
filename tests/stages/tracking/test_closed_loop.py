"""Tracking in a closed loop with a simulated pipeline: it keeps the track, and finds it again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.tracking_world import World, hand_held, most_alike, on_sphere, ring_of_views

from fieldpose.bus.messages import CameraOrigin, GuessReason, TrackingState
from fieldpose.stages.geometry import Limit
from fieldpose.stages.tracking.config import TrackingConfig
from fieldpose.stages.tracking.core import Tracker
from fieldpose.stages.tracking.photos import PhotoPolicy
from fieldpose.stages.tracking.policy import PoseResult
from fieldpose.stages.tracking.priors import Priors
from fieldpose.stages.tracking.video import VideoPolicy

TRACKING, LIMITED, LOST = TrackingState.TRACKING, TrackingState.LIMITED, TrackingState.LOST
VIEWS = ring_of_views()


def following(start: np.ndarray | None = None, looks: bool = False, **config: object) -> Tracker:
    settings = TrackingConfig(**config)  # type: ignore[arg-type]
    return Tracker(settings, VideoPolicy(settings, VIEWS, Priors(), start, looks))


def share(states: list[TrackingState], state: TrackingState) -> float:
    return states.count(state) / len(states)


@pytest.mark.parametrize("depth", [1, 2, 4])
def test_keeps_the_track_of_a_fast_hand(depth: int) -> None:
    world = World(following(hand_held(0), depth=depth), lambda t: hand_held(t, 2.0)).run(8)
    assert share(world.states(1), TRACKING) > 0.98
    assert max(world.worst_error(world.between(1))) < 2.0


def test_a_deeper_pipeline_finishes_more_frames_and_drops_fewer() -> None:
    counts = [World(following(hand_held(0), depth=d), hand_held).run(4).reports[-1].counts for d in (1, 2)]
    assert counts[1].finished > 1.5 * counts[0].finished
    assert counts[1].dropped_at_the_door < counts[0].dropped_at_the_door


def test_results_in_any_order_keep_the_track() -> None:
    world = World(following(hand_held(0), depth=4), hand_held, latency_ms=lambda rng: rng.uniform(60, 400)).run(8)
    finished = [report.frame.frame_id for report in world.reports]
    assert finished != sorted(finished)
    assert share(world.states(1), TRACKING) > 0.98


def test_results_that_never_come_cost_frames_but_not_the_track() -> None:
    world = World(following(hand_held(0), depth=3), hand_held, loses=0.08).run(15)
    assert world.reports[-1].counts.lost > 5
    assert LOST not in world.states(1)
    assert share([r.belief.state for r in world.between(1) if r.belief.score > 0], TRACKING) > 0.95


def leaves_and_returns(seconds: float) -> np.ndarray | None:
    return None if 2 <= seconds < 5 else hand_held(seconds)


@pytest.mark.parametrize("looks", [False, True])
def test_is_lost_without_the_object_and_soon_back_with_it(looks: bool) -> None:
    retrieval = most_alike(VIEWS, leaves_and_returns)
    world = World(following(hand_held(0), looks), leaves_and_returns, retrieval=retrieval).run(9)
    assert set(world.states(3.0, 5.0)) == {LOST}
    assert all(report.belief.cam_from_object is None for report in world.between(3.0, 5.0))
    assert world.states(6.0) == [TRACKING] * len(world.states(6.0))
    assert max(world.worst_error(world.reports)) < 2.0
    assert bool(world.looks) == looks


def test_a_short_failure_is_bridged_by_predictions() -> None:
    world = World(following(hand_held(0)), lambda t: None if 2 <= t < 2.2 else hand_held(t)).run(4)
    gap = world.between(2.0, 2.2)
    assert {report.belief.state for report in gap} == {LIMITED}
    assert all(report.belief.score == 0 and report.belief.cam_from_object is not None for report in gap)
    assert all(report.belief.reason is not None for report in gap)
    assert LOST not in world.states()
    assert share(world.states(2.6), TRACKING) == 1


@pytest.mark.parametrize("start", [None, on_sphere(180, 10)], ids=["no start", "wrong start"])
def test_finds_itself_among_the_training_views(start: np.ndarray | None) -> None:
    world = World(following(start), hand_held).run(10)
    reasons = world.first_reasons()
    assert reasons[0] == (GuessReason.RELOCALISATION if start is None else GuessReason.PRIOR)
    assert share(world.states(7), TRACKING) == 1
    assert max(world.worst_error(world.reports)) < 2.0
    assert world.looks == []


def test_begins_at_once_where_retrieval_is_right_and_then_asks_no_more() -> None:
    world = World(following(looks=True), hand_held, retrieval=most_alike(VIEWS, hand_held)).run(4)
    assert world.first_reasons()[0] is GuessReason.RELOCALISATION
    assert world.states() == [TRACKING] * len(world.states())
    assert max(world.worst_error(world.reports)) < 2.0
    assert 1 <= len(world.looks) <= 2
    assert world.looks[-1].frame.frame_id < 10


def test_retrieval_that_never_answers_delays_the_beginning_but_does_not_prevent_it() -> None:
    tracker = following(looks=True, max_deadline_ms=400.0, min_deadline_ms=400.0)
    world = World(tracker, hand_held, retrieval=lambda frame: None).run(20)
    assert share(world.states(16), TRACKING) == 1
    assert max(world.worst_error(world.reports)) < 2.0
    assert world.looks


def carried(seconds: float) -> np.ndarray:
    return on_sphere(0 if seconds < 2 else 150, 30)


@pytest.mark.parametrize(("looks", "found_by"), [(False, 8.0), (True, 4.0)])
def test_recovers_when_the_camera_is_carried_elsewhere_at_once(looks: bool, found_by: float) -> None:
    world = World(following(on_sphere(0, 30), looks), carried, retrieval=most_alike(VIEWS, carried)).run(9)
    assert LOST in world.states(2, 5)
    assert share(world.states(found_by), TRACKING) == 1
    assert max(world.worst_error(world.between(found_by))) < 2.0


def test_a_cut_to_a_near_place_is_believed_by_the_second_frame() -> None:
    tracker = following(on_sphere(0, 30), jump_per_s=Limit(60, 1))
    world = World(tracker, lambda t: on_sphere(0 if t < 2 else 33, 30)).run(4)
    after = world.states(2)
    assert after[0] is LIMITED
    assert LOST not in after
    assert share(after[4:], TRACKING) == 1


def test_a_good_looking_pose_far_from_the_way_is_not_followed() -> None:
    flipped = set()

    def flip_once(frame_id: int, result: PoseResult) -> PoseResult:
        if frame_id < 60 or (flipped and frame_id not in flipped):
            return result
        flipped.add(frame_id)
        return replace(result, cam_from_object=on_sphere(150, 40))

    world = World(following(hand_held(0)), hand_held, distort=flip_once).run(4)
    assert [r.belief.state for r in world.reports if r.frame.frame_id in flipped] == [LIMITED]
    assert max(world.worst_error(world.reports)) < 2.0
    assert share(world.states(2.5), TRACKING) == 1


def test_weak_poses_limit_the_track_and_good_ones_restore_it() -> None:
    def weakened(frame_id: int, result: PoseResult) -> PoseResult:
        is_weak = 60 < frame_id <= 120
        return replace(result, inliers=min(result.inliers, 12), correspondences=40) if is_weak else result

    world = World(following(hand_held(0), weak_after=40), hand_held, distort=weakened).run(6)
    weak = world.between(61 / 30, 120 / 30)
    assert weak[0].belief.state is TRACKING
    assert set(world.states(3.2, 3.8)) == {LIMITED}
    assert all(report.belief.cam_from_object is not None for report in weak)
    assert share(world.states(4.2), TRACKING) == 1


def test_a_rough_start_takes_more_passes_and_a_smooth_track_one() -> None:
    rough = on_sphere(-22, 42)
    world = World(following(rough, depth=1), hand_held).run(3)
    reasons = [order.guess.reason for order in world.guesses[:3]]
    assert reasons[:2] == [GuessReason.PRIOR, GuessReason.NEXT_PASS]
    assert world.states()[0] is TRACKING
    later = [order for order in world.guesses if order.frame.capture_ns > 1e9]
    assert all(order.pass_index == 0 and order.guess.reason is GuessReason.MOTION for order in later)


def test_an_assumed_camera_is_followed_but_never_trusted() -> None:
    world = World(following(hand_held(0)), hand_held, origin=CameraOrigin.ASSUMED).run(4)
    assert set(world.states()) == {LIMITED}
    assert max(report.belief.score for report in world.reports) == pytest.approx(0.3)
    known = World(following(hand_held(0)), hand_held).run(4)
    assert world.first_reasons() == known.first_reasons()
    for unsure, sure in zip(world.reports, known.reports, strict=True):
        np.testing.assert_array_equal(unsure.belief.cam_from_object, sure.belief.cam_from_object)
        assert unsure.belief.covariance is not None
        assert sure.belief.covariance is not None
        assert (np.linalg.eigvalsh(unsure.belief.covariance - sure.belief.covariance) > 0).all()


AZIMUTHS = np.random.default_rng(3).uniform(0, 360, 300)


def unordered(seconds: float) -> np.ndarray:
    return on_sphere(AZIMUTHS[int(seconds * 30 + 0.5)], 30)


def photos(searches: int, looks: bool = False, depth: int = 1) -> World:
    settings = TrackingConfig(depth=depth, sequence="photos", searches=searches)
    tracker = Tracker(settings, PhotoPolicy(settings, VIEWS, Priors(), looks=looks))
    retrieval = most_alike(VIEWS, unordered)
    return World(tracker, unordered, service_ms=5, latency_ms=lambda rng: 5, look_ms=5, retrieval=retrieval).run(8)


def test_searches_answer_photos_that_have_no_order() -> None:
    alone, searched = photos(0), photos(40)
    assert share(searched.states(), TRACKING) > 0.9
    assert share(searched.states(), TRACKING) > 2 * share(alone.states(), TRACKING)
    assert max(searched.worst_error(searched.reports)) < 2.0


@pytest.mark.parametrize("depth", [1, 3])
def test_photos_that_retrieval_knows_are_found_with_one_look_each(depth: int) -> None:
    world = photos(12, looks=True, depth=depth)
    assert share(world.states(), TRACKING) > 0.99
    assert max(world.worst_error(world.reports)) < 2.0
    looked_at = [look.frame.frame_id for look in world.looks]
    assert len(looked_at) == len(set(looked_at)) >= len(world.reports)
    assert set(world.first_reasons()) == {GuessReason.RELOCALISATION}
    searched = photos(12)
    assert len(world.guesses) / len(world.reports) < len(searched.guesses) / len(searched.reports)
