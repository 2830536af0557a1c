"""The door: who is let in, what is counted, and when a place becomes free."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.tracking_world import frame_info

from fieldpose.bus.messages import CameraOrigin, GuessReason, Reason, TrackingState
from fieldpose.errors import ConfigError
from fieldpose.stages.tracking.config import MotionConfig, TrackingConfig
from fieldpose.stages.tracking.core import GuessOrder, LookOrder, Output, StateReport, Tracker
from fieldpose.stages.tracking.policy import Alike, Attempt, Belief, FrameInfo, Look, PoseGuess, PoseResult, Step

MS = 1_000_000
SOMETHING = Alike([np.eye(4)])


class Anywhere:
    """A policy that guesses the origin, and asks for `passes` passes over each frame.

    known: whether frames have a guess yet. looks: before which passes it asks for what looks like the frame, where it
    takes anything that does, and nothing else.
    """

    def __init__(self, passes: int = 1, known: bool = True, looks: tuple[int, ...] = ()) -> None:
        self.passes, self.known, self.looks = passes, known, looks
        self.seen: list[Alike] = []

    def on_prior(self, frame_id: int, cam_from_object: np.ndarray) -> None:
        self.known = True

    def first_step(self, frame: FrameInfo) -> Step | None:
        if not self.known:
            return None
        return Look() if 0 in self.looks else PoseGuess(GuessReason.PRIOR, np.eye(4))

    def after_look(self, attempt: Attempt, alike: Alike) -> PoseGuess | None:
        self.seen.append(alike)
        nothing = alike.reason is Reason.NOTHING_ALIKE
        return None if nothing else PoseGuess(GuessReason.RELOCALISATION, np.eye(4))

    def next_step(self, attempt: Attempt, result: PoseResult) -> Step | None:
        if attempt.pass_index + 1 >= self.passes:
            return None
        return Look() if attempt.pass_index + 1 in self.looks else PoseGuess(GuessReason.NEXT_PASS, np.eye(4))

    def conclude(self, attempt: Attempt, result: PoseResult) -> Belief:
        if result.cam_from_object is None:
            return Belief(TrackingState.LOST, 0.0, reason=result.reason)
        return Belief(TrackingState.TRACKING, 1.0, result.cam_from_object)

    def missed(self, frame: FrameInfo, reason: Reason) -> Belief:
        return Belief(TrackingState.LOST, 0.0, reason=reason)


def tracker(passes: int = 1, known: bool = True, looks: tuple[int, ...] = (), **config: float) -> Tracker:
    return Tracker(TrackingConfig(**config), Anywhere(passes, known, looks))  # type: ignore[arg-type]


def frame(frame_id: int) -> FrameInfo:
    return frame_info(frame_id, frame_id * 33 * MS)


def done(frame_id: int, pass_index: int = 0) -> PoseResult:
    return PoseResult(frame_id, pass_index, np.eye(4))


def guessed(outputs: list[Output]) -> list[tuple[int, int]]:
    return [(o.frame.frame_id, o.pass_index) for o in outputs if isinstance(o, GuessOrder)]


def searched(outputs: list[Output]) -> list[tuple[int, int]]:
    return [(o.frame.frame_id, o.pass_index) for o in outputs if isinstance(o, LookOrder)]


def reported(outputs: list[Output]) -> list[int]:
    return [o.frame.frame_id for o in outputs if isinstance(o, StateReport)]


def reasons(outputs: list[Output]) -> list[Reason | None]:
    return [o.belief.reason for o in outputs if isinstance(o, StateReport)]


def test_only_the_newest_frame_waits_and_it_enters_when_a_place_is_free() -> None:
    door = tracker(depth=2)
    entered = [guessed(door.on_frame(frame(i), 0)) for i in range(5)]
    assert entered == [[(0, 0)], [(1, 0)], [], [], []]
    assert door.counts.dropped_at_the_door == 2
    outputs = door.on_result(done(1), 10 * MS)
    assert (guessed(outputs), reported(outputs)) == ([(4, 0)], [1])


def test_frames_that_the_bus_let_go_count_as_dropped() -> None:
    door = tracker()
    door.on_frame(frame(0), 0)
    door.on_frame(frame(7), 0, missed=6)
    assert (door.counts.received, door.counts.dropped_at_the_door, door.counts.admitted) == (8, 6, 2)


def test_a_result_past_its_deadline_frees_the_place_and_is_counted_lost() -> None:
    door = tracker(depth=1, max_deadline_ms=1000)
    door.on_frame(frame(0), 0)
    door.on_frame(frame(1), 5 * MS)
    assert door.on_tick(1000 * MS) == []
    outputs = door.on_tick(1001 * MS)
    assert (guessed(outputs), reported(outputs), reasons(outputs)) == ([(1, 0)], [0], [Reason.NO_ANSWER])
    assert (door.counts.lost, door.counts.in_flight) == (1, 1)
    assert door.on_result(done(0), 1002 * MS) == []
    assert (door.counts.late, door.counts.finished) == (1, 0)


def test_the_deadline_follows_the_usual_latency_between_its_limits() -> None:
    door = tracker(depth=1, min_deadline_ms=500, max_deadline_ms=8000)
    assert door.deadline_ms == 8000
    for i in range(40):
        door.on_frame(frame(i), i * MS)
        door.on_result(done(i), i * MS + 100 * MS)
    assert door.deadline_ms == pytest.approx(1000)
    for i in range(40, 80):
        door.on_frame(frame(i), i * MS)
        door.on_result(done(i), i * MS + MS)
    assert door.deadline_ms == 500


def test_a_pipeline_that_becomes_slow_is_not_late_for_ever() -> None:
    door = tracker(depth=1, min_deadline_ms=200, max_deadline_ms=10_000)
    now_ns = 0
    for i, latency_ms in enumerate([20] * 20 + [3000] * 40):
        door.on_frame(frame(i), now_ns)
        for _ in range(latency_ms // 20):
            now_ns += 20 * MS
            door.on_tick(now_ns)
        door.on_result(done(i), now_ns)
    assert 1 <= door.counts.lost < 10
    assert door.counts.in_flight == 0


def test_passes_keep_the_place_and_only_the_last_one_reports() -> None:
    door = tracker(passes=3, depth=1)
    assert guessed(door.on_frame(frame(0), 0)) == [(0, 0)]
    door.on_frame(frame(1), 0)
    first, second = door.on_result(done(0, 0), MS), door.on_result(done(0, 1), 2 * MS)
    assert (guessed(first), guessed(second)) == ([(0, 1)], [(0, 2)])
    assert reported(first) == reported(second) == []
    assert door.on_result(done(0, 1), 3 * MS) == []
    last = door.on_result(done(0, 2), 4 * MS)
    assert (reported(last), guessed(last)) == ([0], [(1, 0)])
    assert door.counts.finished == 1


def test_a_failure_without_another_step_is_reported_with_its_reason() -> None:
    door = tracker()
    door.on_frame(frame(0), 0)
    outputs = door.on_result(PoseResult(0, 0, reason=Reason.TOO_FEW_MATCHES), MS)
    assert (reported(outputs), reasons(outputs)) == ([0], [Reason.TOO_FEW_MATCHES])
    assert (door.counts.finished, door.counts.lost) == (1, 0)


def test_a_frame_waits_for_its_guess_but_not_for_ever() -> None:
    door = tracker(known=False, guess_wait_ms=500)
    assert door.on_frame(frame(0), 0) == []
    assert guessed(door.on_prior(0, np.eye(4), MS)) == [(0, 0)]
    door = tracker(known=False, guess_wait_ms=500)
    door.on_frame(frame(3), 0)
    assert door.on_tick(500 * MS) == []
    outputs = door.on_tick(501 * MS)
    assert (reported(outputs), reasons(outputs)) == ([3], [Reason.NO_GUESS])
    assert (door.counts.admitted, door.counts.dropped_at_the_door, door.counts.waiting) == (0, 1, 0)


def test_a_camera_that_begins_again_does_not_take_over_a_frame_in_flight() -> None:
    door = tracker(depth=2)
    door.on_frame(frame(0), 0)
    assert guessed(door.on_frame(frame(0), MS)) == []
    assert guessed(door.on_result(done(0), 2 * MS)) == [(0, 0)]


def test_a_look_comes_before_the_first_pass_and_takes_a_place() -> None:
    door = tracker(looks=(0,), depth=1)
    first, second = door.on_frame(frame(0), 0), door.on_frame(frame(1), MS)
    assert (searched(first), guessed(first), second) == ([(0, 0)], [], [])
    assert (door.counts.admitted, door.counts.in_flight, door.counts.waiting) == (1, 1, 1)
    assert guessed(door.on_alike(0, SOMETHING, 2 * MS)) == [(0, 0)]
    last = door.on_result(done(0), 3 * MS)
    assert (reported(last), searched(last)) == ([0], [(1, 0)])


def test_a_look_between_passes_goes_on_with_the_next_one() -> None:
    door = tracker(passes=2, looks=(1,), depth=1)
    assert guessed(door.on_frame(frame(0), 0)) == [(0, 0)]
    assert searched(door.on_result(done(0), MS)) == [(0, 0)]
    assert guessed(door.on_alike(0, SOMETHING, 2 * MS)) == [(0, 1)]
    assert reported(door.on_result(done(0, 1), 3 * MS)) == [0]


def test_results_while_a_look_is_awaited_are_late() -> None:
    door = tracker(passes=2, looks=(1,), depth=1)
    door.on_frame(frame(0), 0)
    door.on_result(done(0), MS)
    assert door.on_result(done(0), 2 * MS) == []
    assert (door.counts.late, door.counts.in_flight) == (1, 1)


def test_answers_to_looks_that_nobody_awaits_are_late() -> None:
    door = tracker(looks=(0,), depth=1)
    assert door.on_alike(5, SOMETHING, 0) == []
    door.on_frame(frame(0), 0)
    door.on_alike(0, SOMETHING, MS)
    assert door.on_alike(0, SOMETHING, 2 * MS) == []
    assert (door.counts.late, door.counts.in_flight) == (2, 1)


def test_a_look_that_is_not_answered_in_time_costs_no_frame() -> None:
    policy = Anywhere(looks=(0,))
    door = Tracker(TrackingConfig(max_deadline_ms=1000), policy)
    door.on_frame(frame(0), 0)
    assert door.on_tick(1000 * MS) == []
    assert guessed(door.on_tick(1001 * MS)) == [(0, 0)]
    assert [alike.reason for alike in policy.seen] == [Reason.NO_ANSWER]
    assert (door.counts.lost, door.counts.late, door.counts.in_flight) == (0, 0, 1)
    assert door.on_tick(2001 * MS) == []
    assert reported(door.on_tick(2002 * MS)) == [0]
    assert door.counts.lost == 1


def test_a_look_between_passes_has_a_deadline_of_its_own() -> None:
    door = tracker(passes=2, looks=(1,), depth=1, max_deadline_ms=1000, min_deadline_ms=1000)
    door.on_frame(frame(0), 0)
    assert searched(door.on_result(done(0), 800 * MS)) == [(0, 0)]
    assert door.on_tick(1800 * MS) == []
    assert guessed(door.on_tick(1801 * MS)) == [(0, 1)]


@pytest.mark.parametrize("looks_before", [0, 1])
def test_a_frame_that_nothing_looks_like_ends_with_that_reason_and_frees_its_place(looks_before: int) -> None:
    door = tracker(passes=2, looks=(looks_before,), depth=1)
    door.on_frame(frame(0), 0)
    if looks_before:
        door.on_result(done(0), MS)
    door.on_frame(frame(1), MS)
    outputs = door.on_alike(0, Alike(reason=Reason.NOTHING_ALIKE), 2 * MS)
    assert (reported(outputs), reasons(outputs)) == ([0], [Reason.NOTHING_ALIKE])
    assert [output.pass_index for output in outputs if isinstance(output, StateReport)] == [0]
    assert [o.frame.frame_id for o in outputs if not isinstance(o, StateReport)] == [1]
    assert (door.counts.finished, door.counts.lost) == (1, 0)


def test_looks_say_nothing_about_how_long_a_pass_takes() -> None:
    door = tracker(looks=(0,), depth=1, min_deadline_ms=1, max_deadline_ms=8000)
    door.on_frame(frame(0), 0)
    door.on_alike(0, SOMETHING, 700 * MS)
    door.on_result(done(0), 720 * MS)
    assert door.deadline_ms == pytest.approx(200)


def test_reports_are_no_surer_than_the_camera_of_their_frame() -> None:
    door = tracker(depth=2)
    for i, origin in enumerate((CameraOrigin.TRAINING, CameraOrigin.ASSUMED)):
        door.on_frame(frame_info(i, 0, origin), 0)
    trained, assumed = (door.on_result(done(i), MS)[0] for i in range(2))
    assert isinstance(trained, StateReport)
    assert isinstance(assumed, StateReport)
    assert (trained.belief.state, trained.belief.score) == (TrackingState.TRACKING, 1.0)
    assert (assumed.belief.state, assumed.belief.score) == (TrackingState.LIMITED, 0.3)
    assert assumed.frame.camera_origin is CameraOrigin.ASSUMED


ACTIONS = st.one_of(
    st.tuples(st.just("frame"), st.integers(0, 3)),
    st.tuples(st.just("pose"), st.integers(0, 12), st.integers(0, 2)),
    st.tuples(st.just("alike"), st.integers(0, 12), st.sampled_from([None, Reason.NOTHING_ALIKE])),
    st.tuples(st.just("wait"), st.integers(1, 900)),
    st.tuples(st.just("prior")),
)
LOOKS = st.sets(st.integers(0, 2)).map(lambda passes: tuple(sorted(passes)))


@given(st.lists(ACTIONS, max_size=60), st.integers(1, 4), st.integers(1, 3), st.booleans(), LOOKS)
def test_every_frame_is_accounted_for_whatever_happens(
    actions: list, depth: int, passes: int, known: bool, looks: tuple[int, ...]
) -> None:
    door = tracker(passes, known, looks, depth=depth, max_deadline_ms=1000, min_deadline_ms=300, guess_wait_ms=200)
    now_ns = frames = received = 0
    ended: list[int] = []
    for action in actions:
        match action:
            case "frame", missed:
                outputs = door.on_frame(frame(frames), now_ns, missed)
                frames, received = frames + 1, received + 1 + missed
            case "pose", frame_id, pass_index:
                outputs = door.on_result(done(frame_id, pass_index), now_ns)
            case "alike", frame_id, reason:
                outputs = door.on_alike(frame_id, Alike(reason=reason), now_ns)
            case "wait", ms:
                now_ns += ms * MS
                outputs = door.on_tick(now_ns)
            case _:
                outputs = door.on_prior(0, np.eye(4), now_ns)
        ended += reported(outputs)
        counts = door.counts
        assert counts.received == received
        assert counts.received == counts.admitted + counts.dropped_at_the_door + counts.waiting
        assert counts.admitted == counts.finished + counts.lost + counts.in_flight
        assert 0 <= counts.in_flight <= depth
        assert len(ended) == len(set(ended)) >= counts.finished + counts.lost


@pytest.mark.parametrize(
    "wrong",
    [
        {"depth": 0},
        {"passes": 0},
        {"retries": -1},
        {"guess_wait_ms": -1.0},
    ],
)
def test_settings_out_of_range_are_refused_by_name(wrong: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        TrackingConfig(**wrong)  # type: ignore[arg-type]


def test_settings_of_the_motion_model_are_checked_too() -> None:
    with pytest.raises(ConfigError, match="window_ms"):
        TrackingConfig(motion=MotionConfig(window_ms=-1))
