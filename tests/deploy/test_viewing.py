"""What a page is given: figures second by second, what a live pipeline says, and what its buttons ask."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from support import bus_samples
from support.bus_samples import ADDRESS

from fieldpose.bus.codec import encode
from fieldpose.bus.memory import MemoryBus
from fieldpose.bus.messages import Failure, Header, Message, Reason, State, Stats, TrackingState
from fieldpose.bus.ports import Outbox
from fieldpose.bus.requests import ControlValues, Reset, SnapshotSaved, TakeKeyframe, decode_request
from fieldpose.bus.topics import (
    CAMERA_INFO,
    CORRESPONDENCES,
    FAILURE,
    FRAME,
    GUESS,
    POSE,
    RETRIEVED,
    SEARCH,
    STATE,
    STATS,
    VIEW,
    Address,
    Topic,
)
from fieldpose.deploy.viewing.asking import actions_on
from fieldpose.deploy.viewing.charts import SOLVING
from fieldpose.deploy.viewing.history import History
from fieldpose.deploy.viewing.live import Live
from fieldpose.deploy.viewing.moments import Moment
from fieldpose.errors import RefusedError

S = 1_000_000_000


def header(frame_id: int, at_ms: float, source: str = "", pass_index: int = 0) -> Header:
    return Header(source, 0, frame_id, pass_index, 1000 + frame_id, round(at_ms * 1e6))


def state(frame_id: int, at_ms: float = 0.0, score: float = 0.9, dropped: int = 0, lost: int = 0) -> State:
    return State(
        header=header(frame_id, at_ms), state=TrackingState.TRACKING, score=score, cam_from_object=np.eye(4),
        covariance=None, in_flight=0, admitted=1, finished=1, dropped_at_the_door=dropped, lost=lost,
    )  # fmt: skip


def stats(gaps: int, stage: str = "pnp") -> Stats:
    sample = bus_samples.every_message()[STATS]
    assert isinstance(sample, Stats)
    sample.stage, sample.gaps = stage, gaps
    return sample


def last_second(history: History) -> None:
    """Let the seconds before be over."""
    history.note(stats(0, "hub"), round((history.now + 1) * S))


class TestHistory:
    def test_what_came_each_second(self) -> None:
        history = History(60)
        for number in range(30):
            at_ms = 100.0 * number
            for topic in (FRAME, CAMERA_INFO):  # one frame
                history.note_header(topic, header(number, at_ms), round(at_ms * 1e6))
            history.note(state(number, at_ms + 20 + number % 10, 0.1 * (number % 10)), round(at_ms * 1e6))
        last_second(history)
        rates = history.rates()
        np.testing.assert_array_equal(rates.seconds, [0, 1, 2])
        np.testing.assert_array_equal(rates.lines["camera frames"], [10, 10, 10])
        np.testing.assert_array_equal(rates.lines["poses"], [9, 9, 9])
        np.testing.assert_allclose(history.scores().lines["typical"], 0.45)
        np.testing.assert_allclose(history.scores().lines["lowest"], 0.0)
        np.testing.assert_allclose(history.latencies().lines["typical"], 24.5)
        np.testing.assert_allclose(history.latencies().lines["longest"], 29)

    def test_how_long_each_stage_took_for_a_pass(self) -> None:
        history = History(60)
        said: list[tuple[Topic[Any], Header]] = [
            (SEARCH, header(1, 0, "tracking")),
            (RETRIEVED, header(1, 30, "retrieval")),
            (GUESS, header(1, 500, "tracking")),
            (CORRESPONDENCES, header(1, 570, "lifting")),  # received before what it was made of
            (VIEW, header(1, 550, "rendering")),
            (POSE, header(1, 575, "refinement")),
            (GUESS, header(1, 600, "tracking", 1)),
            (FAILURE, header(1, 690, "rendering", 1)),
            (VIEW, header(7, 700, "rendering")),  # of whose guess nothing is known
        ]
        for topic, each in said:
            history.note_header(topic, each, each.sent_ns)
        last_second(history)
        lines = {name: line.tolist() for name, line in history.stages(SOLVING).lines.items()}
        assert lines == {"retrieval": [30], "rendering": [70], "lifting": [20], "refinement": [5]}
        assert history.rates().lines["solves"].tolist() == [1]

    def test_what_was_lost_and_a_start_anew_is_no_loss(self) -> None:
        history = History(60)
        for second, (dropped, lost, gaps) in enumerate([(5, 0, 9), (7, 1, 9), (0, 0, 0), (1, 0, 4)]):
            history.note(state(second, dropped=dropped, lost=lost), second * S)
            history.note(stats(gaps), second * S)
        last_second(history)
        losses = history.losses().lines
        assert losses["dropped at the door"].tolist() == [0, 2, 0, 1]
        assert losses["lost on their way"].tolist() == [0, 1, 0, 0]
        assert losses["missing messages"].tolist() == [0, 0, 0, 4]

    def test_seconds_without_anything_are_seconds_and_old_ones_go(self) -> None:
        history = History(5)
        for second in (0, 1, 8, 10, 1000):
            history.note(state(second), second * S)
        assert history.rates().seconds.tolist() == [996, 997, 998, 999]
        history = History(5)
        for second in (0, 2):
            history.note(state(second), second * S)
        last_second(history)
        assert history.rates().lines["poses"].tolist() == [1, 0, 1]
        assert history.scores().seconds.tolist() == [0, 2]
        assert history.latencies().seconds.tolist() == []

    def test_nothing_is_known_of_nothing(self) -> None:
        history = History(5)
        for curves in (history.rates(), history.losses(), history.scores(), history.latencies()):
            assert len(curves.seconds) == 0
        assert history.stages(SOLVING).lines == {}


class FakePage:
    """Keeps what it is to show."""

    def __init__(self) -> None:
        self.watched = False
        self.shown: list[Moment] = []
        self.said: list[str] = []
        self.silent: list[float | None] = []
        self.plots = 0

    def asked_otherwise(self) -> bool:
        return False

    def show(self, moment: Moment, way: Any, rate_hz: float | None) -> None:
        self.shown.append(moment)

    def tell(self, moment: Moment, rate_hz: float | None, silent_s: float | None) -> None:
        self.silent.append(silent_s)

    def say(self, line: str) -> None:
        self.said.append(line)

    def plot(self, history: History) -> None:
        self.plots += 1

    def look_for_recorder(self) -> None: ...


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [100.0]
    monkeypatch.setattr("fieldpose.deploy.viewing.live.time.monotonic", lambda: now[0])
    return now


class TestLive:
    @pytest.fixture
    def bus(self) -> Iterator[MemoryBus]:
        bus = MemoryBus()
        yield bus
        bus.close()

    def listened(self, bus: MemoryBus) -> set[str]:
        return {pattern for pattern, _ in bus._room.sinks}

    def test_images_are_asked_for_only_while_somebody_looks(self, bus: MemoryBus, clock: list[float]) -> None:
        page = FakePage()
        live = Live(bus, ADDRESS, page)  # type: ignore[arg-type]
        for watched in (False, True, False):
            page.watched = watched
            live.update()
            assert (ADDRESS.key(FRAME) in self.listened(bus)) == watched
        assert page.plots == 1
        live.close()
        assert self.listened(bus) == set()

    def test_what_comes_is_shown_and_what_does_not_is_said(self, bus: MemoryBus, clock: list[float]) -> None:
        page = FakePage()
        page.watched = True
        live = Live(bus, ADDRESS, page)  # type: ignore[arg-type]
        live.update()
        assert page.said[-1] == "waiting for mug/cam; nothing is running here yet"
        token = bus.hold(Address("test", "cup", "cam").live("tracking"))
        clock[0] += 2
        live.update()
        assert page.said[-1] == "waiting for mug/cam; running here: cup/cam"
        bus.hold(ADDRESS.live("tracking"))
        token.close()
        clock[0] += 2
        live.update()
        assert page.said[-1] == "mug/cam is running; waiting for a frame"
        outbox = Outbox(bus, ADDRESS, "any")
        said: list[tuple[Topic[Any], Message]] = [
            (FRAME, bus_samples.frame(3)), (CAMERA_INFO, bus_samples.camera_info(3)), (STATE, state(3)),
            (STATS, stats(0)), (GUESS, bus_samples.guess(4)),
            (FAILURE, Failure(header=header(4, 0), stage="pnp", reason=Reason.NO_CONSENSUS)),
        ]  # fmt: skip
        for topic, message in said:
            outbox.publish(topic, message)
        bus.put(ADDRESS.key(VIEW), b"no message")
        live.update()
        live.update()
        assert [moment.frame_id for moment in page.shown] == [3]
        assert page.shown[0].frame is not None
        for passed_s, silent_s in ((2.0, None), (2.0, 4.0)):
            clock[0] += passed_s
            live.update()
            assert page.silent[-1] == silent_s
        assert len(page.shown) == 1


class TestAsking:
    def values(self, keyframes: int | None) -> ControlValues:
        return ControlValues(
            state=TrackingState.TRACKING, frames=1, requests=1, solves_per_s=1.0, begins_at=None, keyframes=keyframes
        )

    def test_what_came_of_it_is_one_line(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("fieldpose.deploy.viewing.asking._KEPT_S", 0.3)
        bus, asked = MemoryBus(), []

        def tracking(payload: bytes) -> bytes:
            request = decode_request(payload)
            asked.append(request)
            if isinstance(request, Reset):
                raise RefusedError("each frame stands by itself")
            taken = sum(isinstance(each, TakeKeyframe) for each in asked)
            return encode(self.values(min(taken, 1)))

        bus.serve(ADDRESS.control("tracking"), tracking)
        actions = actions_on(bus, ADDRESS)
        assert actions.reset() == f"Not done: {ADDRESS.control('tracking')}: each frame stands by itself"
        assert actions.guess(np.eye(4)) == "Tracking begins again at this guess."
        assert actions.keyframe() == "The frame was solved, and its view is kept."
        assert "no view is kept yet" in actions.keyframe()

    def test_a_recorder_is_asked_to_save_where_there_is_one(self) -> None:
        bus = MemoryBus()
        actions = actions_on(bus, ADDRESS)
        assert not actions.can_save()
        assert actions.save().startswith("Not done: nobody answers at")
        bus.hold(Address("test", "other", "cam").live("recorder"))
        assert actions.can_save()
        saved = SnapshotSaved(path="out/<now>.mcap", seconds=9.96, messages=700)
        bus.serve(ADDRESS.control("recorder"), lambda payload: encode(saved))
        assert actions.save() == "Saved out/<now>.mcap: 700 messages of 10.0 s."
