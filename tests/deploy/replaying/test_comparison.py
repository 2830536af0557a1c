"""Recorded messages and those of a replay, paired and compared; and the verdict on them."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
import pytest
from support import bus_samples

from fieldpose.bus.messages import Message, State, TrackingState
from fieldpose.bus.ports import first_header
from fieldpose.bus.topics import CORRESPONDENCES, FAILURE, MATCHES, POSE, STATE
from fieldpose.deploy.replaying.comparison import Comparison, TopicComparison
from fieldpose.deploy.replaying.verdict import Closeness, Verdict
from fieldpose.errors import ConfigError
from fieldpose.stages.geometry import rotation_error_deg

SAMPLES = bus_samples.every_message()


def of_frame(message: Any, frame_id: int, **changes: Any) -> Any:
    return msgspec.structs.replace(message, header=first_header(frame_id, 1000 * frame_id), **changes)


def turned(angle_deg: float, shift: float = 0.0) -> np.ndarray:
    """Two units in front of the origin, turned about the optical axis."""
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    return np.array([[c, -s, 0, shift], [s, c, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]], np.float64)


def compare(recorded: list[Message], replayed: list[Message], topic: Any) -> TopicComparison:
    """In the order in which a replay gives them: an answer may come before what was recorded, or after."""
    comparison = Comparison()
    for message in recorded[:1]:
        comparison.recorded(topic, message)
    for message in replayed:
        comparison.replayed(topic, message)
    for message in recorded[1:]:
        comparison.recorded(topic, message)
    return comparison.topics()[topic.name]


def poses(*values: np.ndarray) -> list[Message]:
    return [of_frame(SAMPLES[POSE], i, cam_from_object=value) for i, value in enumerate(values)]


def test_the_same_messages_are_identical_whoever_sent_them_when() -> None:
    recorded = [of_frame(SAMPLES[MATCHES], i) for i in range(4)]
    header = msgspec.structs.replace
    replayed = [
        msgspec.structs.replace(m, header=header(m.header, source="other", sequence=7, sent_ns=9, capture_ns=5))
        for m in recorded
    ]
    of = compare(recorded, list(reversed(replayed)), MATCHES)
    assert (of.both, of.same, of.only_recorded, of.only_replayed) == (4, 4, 0, 0)
    assert of.identical
    assert not of.fields


def test_each_field_that_differs_is_named_with_its_largest_difference() -> None:
    before = of_frame(SAMPLES[CORRESPONDENCES], 0)
    other = np.array(before.confidence)
    other[0] += 0.25
    after = msgspec.structs.replace(before, confidence=other, kept=~np.array(before.kept))
    of = compare([before, of_frame(before, 1)], [after, of_frame(before, 1)], CORRESPONDENCES)
    assert (of.both, of.same) == (2, 1)
    assert {name: (found.messages, found.largest) for name, found in of.fields.items()} == {
        "confidence": (1, pytest.approx(0.25)),
        "kept": (1, 1.0),
    }


def test_arrays_of_other_lengths_differ_without_a_number() -> None:
    before = of_frame(SAMPLES[MATCHES], 0)
    fields = {name: getattr(before, name)[:-1] for name in ("pixels_in_view", "pixels_in_frame", "confidence")}
    of = compare([before], [msgspec.structs.replace(before, **fields)], MATCHES)
    assert set(of.fields) == set(fields)
    assert all(found.largest is None for found in of.fields.values())


def test_what_is_in_one_alone_is_counted_there() -> None:
    recorded, replayed = poses(turned(0), turned(0), turned(0))[:2], poses(turned(0), turned(0), turned(0))[1:]
    of = compare(recorded, replayed, POSE)
    assert (of.both, of.only_recorded, of.only_replayed) == (1, 1, 1)
    assert not of.identical


def test_a_frame_that_comes_twice_is_paired_twice_and_failures_by_their_stage() -> None:
    twice = [of_frame(SAMPLES[POSE], 3), of_frame(SAMPLES[POSE], 3)]
    assert compare(twice, twice, POSE).both == 2
    failures = [of_frame(SAMPLES[FAILURE], 3, stage="pnp"), of_frame(SAMPLES[FAILURE], 3, stage="matching")]
    of = compare(failures[:1], failures[1:], FAILURE)
    assert (of.both, of.only_recorded, of.only_replayed) == (0, 1, 1)


def test_a_check_is_passed_within_its_limits_and_failed_beyond() -> None:
    recorded = poses(*[turned(0)] * 10)
    replayed = poses(*[turned(0.1, 0.01)] * 9, turned(0.5))
    verdict = Verdict(10, 10, {POSE.name: compare(recorded, replayed, POSE)})
    assert rotation_error_deg(turned(0), turned(0.5)) == pytest.approx(0.5)
    assert verdict.complaints("close", Closeness(within_deg=0.2, within=0.006, share=0.9)) == []
    (line,) = verdict.complaints("close", Closeness(within_deg=0.2, within=0.006))
    assert "90.0%" in line
    (line,) = verdict.complaints("close", Closeness(within_deg=1, within=0.004))
    assert "10.0%" in line  # the shift of 0.01 is half a percent of the distance
    (line,) = verdict.complaints("exact", Closeness())
    assert "10 of 10 differ in cam_from_object" in line


def test_a_recorded_pose_that_is_not_found_again_is_not_close() -> None:
    recorded = poses(turned(0), turned(0))
    verdict = Verdict(2, 2, {POSE.name: compare(recorded, recorded[:1], POSE)})
    assert verdict.complaints("close", Closeness(share=0.5)) == []
    assert verdict.complaints("close", Closeness(share=0.6))


def test_a_state_counts_by_what_it_is_sure_of() -> None:
    sure = of_frame(SAMPLES[STATE], 0, state=TrackingState.TRACKING, score=0.9, cam_from_object=turned(0))
    lost: State = msgspec.structs.replace(sure, state=TrackingState.LOST, score=0.0)
    close = Closeness(share=0.01)
    assert Verdict(1, 1, {STATE.name: compare([sure], [lost], STATE)}).complaints("close", close)
    (line,) = Verdict(1, 1, {STATE.name: compare([lost], [sure], STATE)}).complaints("close", close)
    assert "1 poses are said now, and none was recorded" in line
    assert Verdict(1, 1, {STATE.name: compare([lost], [lost], STATE)}).complaints("close", close) == []
    (line,) = Verdict(0, 0, {}).complaints("close", close)
    assert "nothing with poses was recorded" in line


def test_messages_without_an_answer_fail_every_check() -> None:
    of = compare(poses(turned(0)), poses(turned(0)), POSE)
    for check in ("exact", "close"):
        (line,) = Verdict(5, 4, {POSE.name: of}).complaints(check, Closeness())  # type: ignore[arg-type]
        assert "1 of 5 were not answered" in line


@pytest.mark.parametrize("bad", [{"within_deg": -1}, {"within": -0.1}, {"share": 0}, {"share": 1.1}])
def test_limits_that_cannot_be_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match="expected limits"):
        Closeness(**bad)
