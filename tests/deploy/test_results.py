"""Figures of a run: from messages on a bus to the keys that programs rely on."""

from __future__ import annotations

import copy
import csv
import io
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from support import bus_samples

from fieldpose.bus.memory import MemoryBus
from fieldpose.bus.messages import Failure, Header, Pose, Reason, State, TrackingState
from fieldpose.bus.ports import Outbox, first_header
from fieldpose.bus.reading import RecordingInfo, SourceInfo, TopicInfo
from fieldpose.bus.topics import (
    CORRESPONDENCES,
    ESTIMATE,
    FAILURE,
    FRAME,
    GUESS,
    MATCHES,
    POSE,
    STATE,
    STATS,
    TRUTH,
    VIEW,
    Address,
)
from fieldpose.deploy.graph import STAGES
from fieldpose.deploy.processes.collector import Collector
from fieldpose.deploy.processes.liveness import Fault
from fieldpose.deploy.reporting.report import rows
from fieldpose.deploy.reporting.results import FrameResult, RunResult, TruthKnown, accuracy, rate_hz, summarise, to_csv
from fieldpose.stages.geometry import Similarity, exp_se3, rotation_about

ADDRESS = Address("test", "mug", "cam")


def moved(turn_deg: float = 0.0, shift: float = 0.0) -> np.ndarray:
    return exp_se3(np.array([0, 0, 0, 0, np.deg2rad(turn_deg), 0.0])) @ exp_se3(np.array([shift, 0, 0, 0, 0, 0.0]))


def result(frame_id: int, turn_deg: float | None, shift: float = 0.0, **values: object) -> FrameResult:
    pose = None if turn_deg is None else moved(turn_deg, shift)
    defaults: dict[str, object] = {
        "truth": TruthKnown(np.eye(4)), "sent_ns": frame_id * 10**9, "answered_ns": frame_id * 10**9 + 10**8,
    }  # fmt: skip
    return FrameResult(frame_id, frame_id, "finished", cam_from_object=pose, **(defaults | values))  # type: ignore[arg-type]


def test_a_frame_without_a_pose_counts_as_a_failure() -> None:
    figures = accuracy([result(0, 1.0, 0.01), result(1, 4.0, 0.2), result(2, 20.0), result(3, None)])
    assert figures["frames_with_truth"] == 4
    assert figures["share_re_below_5deg"] == pytest.approx(2 / 4)
    assert figures["share_te_below_0.05"] == pytest.approx(2 / 4)
    assert figures["rotation_error_deg"]["median"] == pytest.approx(4.0, abs=1e-6)
    assert figures["rotation_error_deg"]["mean"] == pytest.approx(25 / 3, abs=1e-6)


def test_without_truth_there_are_no_errors_and_out_of_view_is_no_failure() -> None:
    unknown = accuracy([result(0, 1.0, truth=None)])
    assert unknown["rotation_error_deg"] is None
    assert unknown["share_re_below_5deg"] is None
    away = accuracy([result(0, 1.0, truth=TruthKnown(None)), result(1, None, truth=TruthKnown(None)), result(2, 0.0)])
    assert away["out_of_view"] == {"frames": 2, "poses_ok": 1}
    assert away["frames_with_truth"] == 1
    assert away["share_re_below_5deg"] == 1.0


def test_the_rate_is_over_the_time_from_first_sent_to_last_answered() -> None:
    assert rate_hz([result(i, 0.0) for i in range(5)]) == pytest.approx(5 / 4.1)
    assert rate_hz([]) == 0.0


def test_lost_messages_are_those_the_numbers_lack_or_only_the_command_has_heard() -> None:
    topics = [TopicInfo("a", "pose", 8, 0, 1, 1.0), TopicInfo("b", "view", 10, 0, 1, 1.0)]
    sources = [SourceInfo("a", "x", 8, 8, 2), SourceInfo("b", "y", 12, 10, 0)]
    recording = RecordingInfo("f", 1, 18, 0, 1, False, topics, sources)
    run = RunResult([], recording=recording, observed={"a": 9, "b": 15, "c": 1})
    assert summarise(run)["messages"] == {"recorded": 18, "lost": 2 + 5 + 1}
    assert summarise(RunResult([]))["messages"] == {"recorded": 0, "lost": 0}


def test_the_rows_hold_pose_and_errors() -> None:
    certain = replace(result(3, 2.0, 0.0), covariance=np.diag([1e-4, 0, 0, np.deg2rad(0.5) ** 2, 0, 0]))
    written = to_csv([(ADDRESS, [certain, result(4, None)]), (Address(object="bowl", camera="left"), [result(5, 1.0)])])
    rows = list(csv.DictReader(io.StringIO(written.decode())))
    assert [(row["frame_id"], row["object"], row["camera_name"]) for row in rows] == [
        ("3", ADDRESS.object, ADDRESS.camera), ("4", ADDRESS.object, ADDRESS.camera), ("5", "bowl", "left"),
    ]  # fmt: skip
    assert float(rows[0]["sigma_translation"]) == pytest.approx(0.01)
    assert float(rows[0]["sigma_rotation_deg"]) == pytest.approx(0.5)
    assert rows[1]["sigma_translation"] == ""
    assert float(rows[0]["rotation_error_deg"]) == pytest.approx(2.0, abs=1e-6)
    assert float(rows[0]["cam_from_object_00"]) == pytest.approx(np.cos(np.deg2rad(2)))
    assert rows[1]["cam_from_object_00"] == rows[1]["rotation_error_deg"] == ""


@pytest.fixture
def collected() -> Iterator[tuple[Collector, dict[str, Outbox]]]:
    bus = MemoryBus()
    collector = Collector(bus, ADDRESS)
    yield collector, {name: Outbox(bus, ADDRESS, name) for name in STAGES}
    collector.close()


def state(header: Header, pose: np.ndarray | None, score: float, reason: Reason | None = None) -> State:
    return State(
        header=header, state=TrackingState.TRACKING, score=score, cam_from_object=pose, covariance=None, reason=reason,
        in_flight=0, admitted=1, finished=1, dropped_at_the_door=0, lost=0,
    )  # fmt: skip


def pose(header: Header) -> Pose:
    return Pose(
        header=header, cam_from_object=np.eye(4), covariance=np.eye(6), inliers=9,
        correspondences=9, residual_px=1.0, refined=False, loss_before=None, loss_after=None,
    )  # fmt: skip


def one_pass(outboxes: dict[str, Outbox], frame_id: int, pass_index: int = 0) -> None:
    header = first_header(frame_id, 1000 + frame_id, pass_index)
    messages = {**bus_samples.every_message(), POSE: pose(header)}
    for name, topic in (
        ("tracking", GUESS), ("rendering", VIEW), ("matching", MATCHES), ("lifting", CORRESPONDENCES),
        ("pnp", ESTIMATE), ("refinement", POSE),
    ):  # fmt: skip
        message = copy.copy(messages[topic])
        message.header = header
        outboxes[name].publish(topic, message)


def test_what_goes_over_the_bus_becomes_rows(collected: tuple[Collector, dict[str, Outbox]]) -> None:
    collector, outboxes = collected
    for frame_id in range(4):
        outboxes["camera"].publish(FRAME, bus_samples.frame(frame_id))
        outboxes["camera"].publish(TRUTH, bus_samples.truth(frame_id))
    for pass_index in (0, 1):
        one_pass(outboxes, 0, pass_index)
    outboxes["tracking"].publish(STATE, state(first_header(0, 1000, 1), np.eye(4), 0.9))
    one_pass(outboxes, 1)
    outboxes["tracking"].publish(STATE, state(first_header(1, 1001), np.eye(4), 0.0))
    outboxes["tracking"].publish(GUESS, bus_samples.guess(2))
    outboxes["tracking"].publish(STATE, state(first_header(2, 1002), None, 0.0, Reason.NO_ANSWER))
    collector.update()
    rows = collector.results()
    assert [row.outcome for row in rows] == ["finished", "finished", "lost", "dropped"]
    assert [row.passes for row in rows[:3]] == [2, 1, 1]
    assert [row.cam_from_object is not None for row in rows] == [True, False, False, False]
    assert rows[0].errors == pytest.approx((0.0, 0.0), abs=1e-6)
    assert set(rows[0].stage_ms) == {"tracking", "rendering", "matching", "lifting", "pnp", "refinement"}
    total = rows[0].latency_ms
    assert total is not None
    assert sum(rows[0].stage_ms.values()) == pytest.approx(total, rel=1e-6)
    assert rows[2].latency_ms is None
    assert (rows[2].reason, rows[0].reason) == ("no_answer", None)
    assert rows[0].camera_origin == "calibrated"


def test_of_a_long_run_the_newest_frames_are_kept_and_the_others_counted(
    collected: tuple[Collector, dict[str, Outbox]], monkeypatch: pytest.MonkeyPatch
) -> None:
    collector, outboxes = collected
    monkeypatch.setattr(collector._gathering, "_kept", 3)
    for frame_id in range(5):
        outboxes["camera"].publish(FRAME, bus_samples.frame(frame_id))
        outboxes["tracking"].publish(STATE, state(first_header(frame_id, 1000 + frame_id), np.eye(4), 0.9))
        collector.update()
    figures = summarise(RunResult(collector.results(), sent=collector.sent, forgotten=collector.forgotten))
    assert (figures["frames_sent"], figures["frames"], figures["frames_forgotten"]) == (5, 3, 2)
    assert figures["dropped_at_the_door"] == 0
    assert ("frames before, in no figure below", "2") in list(rows(figures))


def test_a_failure_ends_a_pass_and_its_reason_is_told(collected: tuple[Collector, dict[str, Outbox]]) -> None:
    collector, outboxes = collected
    header = first_header(0, 1000)
    outboxes["camera"].publish(FRAME, bus_samples.frame(0))
    outboxes["tracking"].publish(GUESS, bus_samples.guess(0))
    failure = Failure(header=header, stage="rendering", reason=Reason.NOTHING_IN_VIEW)
    outboxes["rendering"].publish(FAILURE, failure)
    outboxes["tracking"].publish(STATE, state(header, None, 0.0, Reason.NOTHING_IN_VIEW))
    collector.update()
    (row,) = collector.results()
    assert (row.outcome, row.reason, row.cam_from_object) == ("finished", "nothing_in_view", None)
    assert set(row.stage_ms) == {"tracking", "rendering"}
    assert summarise(RunResult([row]))["reasons"] == {"nothing_in_view": 1}


def test_a_state_of_its_own_ends_a_frame_whatever_the_stages_do(
    collected: tuple[Collector, dict[str, Outbox]],
) -> None:
    collector, outboxes = collected
    for frame_id in range(4):
        outboxes["camera"].publish(FRAME, bus_samples.frame(frame_id))
    outboxes["tracking"].publish(STATE, state(first_header(0, 1000), np.eye(4), 0.9))
    outboxes["tracking"].publish(STATE, state(first_header(1, 1001), np.eye(4), 0.8))
    one_pass(outboxes, 1)
    outboxes["tracking"].publish(STATE, state(first_header(2, 1002), moved(shift=0.1), 0.0, Reason.NO_CONSENSUS))
    collector.update()
    rows = collector.results()
    assert [row.outcome for row in rows] == ["finished", "finished", "finished", "dropped"]
    assert [row.passes for row in rows[:3]] == [0, 1, 0]
    assert set(rows[0].stage_ms) == {"tracking"}
    assert rows[1].stage_ms["refinement"] > 0
    latency = rows[1].latency_ms
    assert latency is not None
    assert rows[1].stage_ms["tracking"] >= latency
    assert rows[2].cam_from_object is None
    assert rows[2].carried is not None
    assert rows[0].carried is None
    summary = summarise(RunResult(rows, collector.sent))
    assert (summary["frames"], summary["poses_ok"], summary["dropped_at_the_door"]) == (3, 2, 1)
    assert summary["passes"] == 1.0


def test_the_documented_keys_are_there(collected: tuple[Collector, dict[str, Outbox]]) -> None:
    collector, outboxes = collected
    outboxes["camera"].publish(FRAME, bus_samples.frame(0))
    one_pass(outboxes, 0)
    outboxes["tracking"].publish(STATE, state(first_header(0, 1000), np.eye(4), 0.9))
    outboxes["pnp"].publish(STATS, bus_samples.every_message()[STATS])
    collector.update()
    summary = summarise(RunResult(collector.results(), collector.sent, collector.stats, collector.observed, {"pnp": 2}))
    assert summary["frames"] == summary["poses_ok"] == summary["frames_sent"] == 1
    assert summary["restarts"] == {"pnp": 2}
    assert set(summary["latency_ms"]) == {"p50", "p90", "p99", "by_stage"}
    assert set(summary["latency_ms"]["by_stage"]["matching"]) == {"p50", "p90"}
    assert summary["processes"]["pnp"]["rss_mb"] > 0
    assert collector.rate_hz(collector.results()[0].answered_ns or 0) > 0


def test_true_poses_are_brought_into_the_fields_frame() -> None:
    bus = MemoryBus()
    moved = Similarity(2.0, rotation_about(np.array([1.0, 2.0, 3.0]), 0.7)[:3, :3], np.array([1.0, -2.0, 0.5]))
    collector, outbox = Collector(bus, ADDRESS, moved), Outbox(bus, ADDRESS, "camera")
    outbox.publish(FRAME, bus_samples.frame(0))
    outbox.publish(TRUTH, bus_samples.truth(0))
    collector.update()
    (row,) = collector.results()
    truth = np.array(bus_samples.truth(0).cam_from_object)
    np.testing.assert_allclose(row.true_pose, moved.of_poses(truth[None])[0], atol=1e-12)
    collector.close()


def test_frames_that_the_command_has_not_heard_count_as_sent() -> None:
    bus, kept = MemoryBus(), []
    bus.subscribe(ADDRESS.key(FRAME), lambda key, payload, at: kept.append((key, payload)), 8)
    outbox = Outbox(bus, ADDRESS, "camera")
    for frame_id in range(5):
        outbox.publish(FRAME, bus_samples.frame(frame_id))
    listening = MemoryBus()
    collector = Collector(listening, ADDRESS)
    for heard in (1, 4):
        listening.put(*kept[heard])
    collector.update()
    assert collector.sent == 5
    assert len(collector.results()) == 2
    collector.close()


def test_a_fault_is_told_with_how_long_and_how_many_frames_it_cost() -> None:
    pose = np.eye(4)
    frames = [
        FrameResult(i, i * 10**9, "finished", sent_ns=i * 10**9, cam_from_object=None if 3 <= i <= 5 else pose)
        for i in range(1, 9)
    ]
    faults = [Fault("tracking", "hung", 2 * 10**9, 6 * 10**9), Fault("pnp", "ended", 7 * 10**9)]
    first, second = summarise(RunResult(frames, faults=faults))["faults"]
    assert first == {"process": "tracking", "what": "hung", "at_s": 1.0, "away_s": 4.0, "frames_without_pose": 3}
    assert second == {"process": "pnp", "what": "ended", "at_s": 6.0, "away_s": None, "frames_without_pose": 0}
    told = dict(rows(summarise(RunResult(frames, faults=faults))))
    assert told["tracking hung and was replaced"] == "back after 4.0 s, 3 frames without a pose"
    assert told["pnp ended unasked"] == "not back, 0 frames without a pose"
