"""Faults at random: the dice, the judge, and a few of them for real."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fieldpose.deploy.benchmarks.chaos.events import PAUSE_S, SUPERVISOR, Event, Kind, Round, drawn
from fieldpose.deploy.benchmarks.chaos.injector import Done
from fieldpose.deploy.benchmarks.chaos.judging import back_s, judged, wrong
from fieldpose.deploy.benchmarks.chaos.measure import figures_of
from fieldpose.deploy.benchmarks.chaos.rounds import film, play
from fieldpose.deploy.benchmarks.sequences import LIMIT, demo
from fieldpose.deploy.processes.liveness import Fault
from fieldpose.deploy.reporting.results import FrameResult, TruthKnown

SECOND = 1_000_000_000
NAMES = ("hub", "recorder", "camera", "tracking", "rendering")


def frames(first_s: float, last_s: float, tracked: bool = True, hz: int = 20) -> list[FrameResult]:
    """States of frames that were each answered at once."""
    times = [round(at * SECOND / hz) for at in range(round(first_s * hz), round(last_s * hz))]
    return [
        FrameResult(
            at, at, "finished", state="tracking" if tracked else "lost", answered_ns=at,
            cam_from_object=np.eye(4) if tracked else None, truth=TruthKnown(np.eye(4)),
        )
        for at in times
    ]  # fmt: skip


def test_the_dice_fall_the_same_way_again_and_leave_nothing_out() -> None:
    rounds = drawn(3, 400, NAMES)
    assert rounds == drawn(3, 400, NAMES) != drawn(4, 400, NAMES)
    events = [event for one in rounds for event in one.events]
    assert len(events) == 400
    signals = {(kind, name) for kind in (Kind.KILL, Kind.STOP, Kind.PAUSE) for name in (*NAMES, SUPERVISOR)}
    assert {(event.kind, event.process) for event in events} == signals | {(kind, "") for kind in tuple(Kind)[3:]}
    assert all(len(one.events) == 1 for one in rounds if any(event.ends_run for event in one.events))
    assert all(sorted(one.order) == sorted(NAMES) for one in rounds)
    assert len({one.order for one in rounds}) > 50
    without = [event.kind for one in drawn(3, 400, NAMES, [Kind.CUT]) for event in one.events]
    assert Kind.CUT not in without
    assert Kind.FULL in without


def test_tracking_is_back_where_half_a_second_of_it_begins() -> None:
    some = [*frames(0, 1), *frames(1, 2.5, tracked=False), *frames(2.5, 2.6), *frames(2.6, 3, False), *frames(3, 5)]
    assert back_s(some, 1 * SECOND) == pytest.approx(2.0)
    assert back_s(some, round(0.2 * SECOND)) == pytest.approx(0.0)
    assert back_s(some, 1 * SECOND, until_ns=3 * SECOND) is None
    assert back_s(some, 6 * SECOND) is None


def test_each_event_must_be_told_and_nothing_else() -> None:
    done = [
        Done(Event(Kind.KILL, "camera"), 1 * SECOND, 1, 1 * SECOND),
        Done(Event(Kind.STOP, "tracking"), 5 * SECOND, 2, 8 * SECOND),
        Done(Event(Kind.PAUSE, "hub"), 12 * SECOND, 3, round((12 + PAUSE_S) * SECOND)),
    ]
    seen = [*frames(0, 5), *frames(5, 8.5, False), *frames(8.5, 20)]
    told = [Fault("camera", "ended", SECOND), Fault("tracking", "hung", 5 * SECOND)]
    camera, tracking, hub = judged(done, seen, told)
    assert [verdict.problems for verdict in (camera, tracking, hub)] == [[], [], []]
    assert (tracking.away_s, tracking.back_s, tracking.without_pose) == (3.0, pytest.approx(0.5), 70)
    (only,) = judged(done[1:2], seen, [])
    assert only.problems == ["not reported"]
    (starved,) = judged(done[1:2], seen, [replace(told[1], silent_ns=2 * SECOND, back_ns=9 * SECOND)])
    assert starved.problems == []
    (before,) = judged(done[1:2], seen, [replace(told[1], silent_ns=2 * SECOND, back_ns=4 * SECOND)])
    assert before.problems == ["not reported", "reported though nothing was done to it: tracking hung"]
    (other,) = judged(done[1:2], seen, [replace(told[1], what="ended")])
    assert other.problems == ["reported as ended"]
    (false,) = judged(done[:1], seen, [*told, Fault("pnp", "hung", 3 * SECOND)])
    assert false.problems == ["reported though nothing was done to it: tracking hung, pnp hung"]
    (late,) = judged(done[:1], [*frames(0, 1), *frames(1, 3.5, False), *frames(3.5, 6)], told[:1])
    assert late.problems == ["tracks again after 2.5 s"]


def test_only_poses_said_to_be_tracking_can_be_wrong_carried_ones_too() -> None:
    far = np.eye(4)
    far[0, 3] = 0.06
    right, bad = frames(0, 0.1)
    bad = replace(bad, cam_from_object=far)
    carried = replace(bad, frame_id=7, cam_from_object=None, carried=far)
    found = wrong([right, bad, carried, replace(bad, state="limited"), replace(bad, truth=None)], LIMIT)
    assert [(one.frame_id, one.carried) for one in found] == [(bad.frame_id, False), (7, True)]
    assert found[0].translation_error == pytest.approx(0.06)


@pytest.mark.slow
def test_a_run_survives_what_is_done_to_it_and_leaves_nothing_behind(tmp_path: Path) -> None:
    kill = [Event(Kind.KILL, name) for name in ("tracking", "hub", "matching", "camera", "recorder")]
    followed = replace(demo(), limit=LIMIT)
    source = film(tmp_path / "film.mcap", followed.recording, 40.0)
    events = (Event(Kind.STOP, "rendering"), *kill)
    played = play(Round(events, ("tracking", "recorder", "camera")), source, followed, settled_s=0.5)
    figures = figures_of([played])
    # Times are for the benchmark: here other tests may take the cores.
    problems = [problem for row in figures["rows"] for problem in row["problems"]]
    assert [problem for problem in problems if "tracks again after" not in problem] == []
    assert (figures["happened"], figures["problems"], figures["wrong"]) == (6, [], [])
    assert all(row["back_s"] is not None for row in figures["rows"])


@pytest.mark.slow
def test_a_run_whose_supervisor_is_killed_ends_with_one_line_and_leaves_nothing_behind(tmp_path: Path) -> None:
    followed = demo()
    source = film(tmp_path / "film.mcap", followed.recording, 10.0)
    played = play(Round((Event(Kind.KILL, SUPERVISOR),), ()), source, followed)
    figures = figures_of([played])
    assert (figures["happened"], figures["failed"], figures["problems"]) == (1, 0, [])
