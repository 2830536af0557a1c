"""Tracking in a closed loop with a simulated pipeline: it keeps the track, and finds it again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fieldpose.stages.tracking.track_policy import TrackPolicy
from support.tracking_world import World, hand_held, on_sphere, ring_of_views

from fieldpose.bus.messages import GuessReason, TrackingState
from fieldpose.errors import ConfigError
from fieldpose.stages.nerf.training_views import TrainingViews
from fieldpose.stages.tracking.config import TrackingConfig
from fieldpose.stages.tracking.core import Tracker
from fieldpose.stages.tracking.policy import PoseResult

TRACKING, LIMITED, LOST = TrackingState.TRACKING, TrackingState.LIMITED, TrackingState.LOST
VIEWS = ring_of_views()


def following(start: np.ndarray | None = None, views: TrainingViews = VIEWS, **config: object) -> Tracker:
    settings = TrackingConfig(**config)  # type: ignore[arg-type]
    return Tracker(settings, TrackPolicy(settings, views, start))


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


def test_is_lost_without_the_object_and_soon_back_with_it() -> None:
    world = World(following(hand_held(0)), leaves_and_returns).run(9)
    assert set(world.states(3.0, 5.0)) == {LOST}
    assert all(report.belief.cam_from_object is None for report in world.between(3.0, 5.0))
    assert world.states(6.0) == [TRACKING] * len(world.states(6.0))
    assert max(world.worst_error(world.reports)) < 2.0


def test_a_short_failure_is_bridged_by_predictions() -> None:
    world = World(following(hand_held(0)), lambda t: None if 2 <= t < 2.2 else hand_held(t)).run(4)
    gap = world.between(2.0, 2.2)
    assert {report.belief.state for report in gap} == {LIMITED}
    assert all(report.belief.score == 0 and report.belief.cam_from_object is not None for report in gap)
    assert LOST not in world.states()
    assert share(world.states(2.6), TRACKING) == 1


@pytest.mark.parametrize("start", [None, on_sphere(180, 10)], ids=["no start", "wrong start"])
def test_finds_itself_among_the_training_views(start: np.ndarray | None) -> None:
    world = World(following(start), hand_held).run(10)
    reasons = world.first_reasons()
    assert reasons[0] == (GuessReason.RELOCALISATION if start is None else GuessReason.PRIOR)
    assert share(world.states(7), TRACKING) == 1
    assert max(world.worst_error(world.reports)) < 2.0


def test_recovers_when_the_camera_is_carried_elsewhere_at_once() -> None:
    world = World(following(on_sphere(0, 30)), lambda t: on_sphere(0 if t < 2 else 150, 30)).run(9)
    assert LOST in world.states(2, 5)
    assert share(world.states(8), TRACKING) == 1
    assert max(world.worst_error(world.between(8))) < 2.0


def test_a_cut_to_a_near_place_is_believed_by_the_second_frame() -> None:
    tracker = following(on_sphere(0, 30), jump_deg_per_s=60.0)
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
        return replace(result, inliers=min(result.inliers, 12), correspondences=40) if frame_id > 60 else result

    world = World(following(hand_held(0), weak_after=40), hand_held, distort=weakened).run(4)
    assert world.states(3)[-1] is LIMITED
    assert world.reports[-1].belief.cam_from_object is not None


def test_a_rough_start_takes_more_passes_and_a_smooth_track_one() -> None:
    rough = on_sphere(-22, 42)
    world = World(following(rough, depth=1), hand_held).run(3)
    reasons = [order.guess.reason for order in world.guesses[:3]]
    assert reasons[:2] == [GuessReason.PRIOR, GuessReason.NEXT_PASS]
    assert world.states()[0] is TRACKING
    later = [order for order in world.guesses if order.frame.capture_ns > 1e9]
    assert all(order.pass_index == 0 and order.guess.reason is GuessReason.MOTION for order in later)


def test_searches_answer_photos_that_have_no_order() -> None:
    azimuths = np.random.default_rng(3).uniform(0, 360, 300)

    def photos(searches: int) -> World:
        tracker = following(depth=1, sequence="photos", searches=searches)
        path = lambda t: on_sphere(azimuths[int(t * 30 + 0.5)], 30)  # noqa: E731
        return World(tracker, path, service_ms=10, latency_ms=lambda rng: 10).run(8)

    alone, searched = photos(0), photos(12)
    assert share(searched.states(1), TRACKING) > 0.9
    assert share(searched.states(1), TRACKING) > 2 * share(alone.states(1), TRACKING)
    assert max(searched.worst_error(searched.reports)) < 2.0


def test_without_any_pose_to_begin_with_it_says_so() -> None:
    with pytest.raises(ConfigError, match="--guess"):
        following(views=TrainingViews((), np.zeros((0, 4, 4))))
