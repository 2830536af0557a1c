"""The life of a stage: answers, failures, heartbeat, signals; in threads, and in processes that are killed."""

from __future__ import annotations

import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest
from support.bus_samples import ADDRESS, camera_info, frame, guess, matches, prior, view

from fieldpose.bus import node
from fieldpose.bus.messages import Failure, Matches, Message, Reason, Stats
from fieldpose.bus.node import EndOfInput, Handler, Joined, JoinedHandler, KeepsTime, Output, run_node
from fieldpose.bus.ports import Inbox, Outbox, Received
from fieldpose.bus.topics import CAMERA_INFO, FAILURE, FRAME, GUESS, MATCHES, PRIOR, STATS, TRUTH, VIEW, Topic
from fieldpose.bus.transport import MemoryBus, ZenohBus, wait_for

Connect = Callable[[str], ZenohBus]
Spawn = Callable[..., "subprocess.Popen[str]"]


class Matching(JoinedHandler):
    """A stage in small: frame 12 is too hard, frame 13 is beyond it."""

    name = "matching"
    inputs = (VIEW, FRAME)
    output = MATCHES
    join_timeout_s = 0.1

    def answer(self, joined: Joined) -> Message | Reason:
        frame_id = joined[FRAME].header.frame_id
        if frame_id == 12:
            return Reason.TOO_FEW_MATCHES
        if frame_id == 13:
            raise RuntimeError("beyond me")
        return matches(joined.header, count=frame_id)


class Lenient(JoinedHandler):
    """A stage that can do without the prior, and needs camera and guess."""

    name = "pnp"
    inputs: tuple[Topic[Any], ...] = (VIEW, CAMERA_INFO, GUESS, PRIOR)
    output = MATCHES
    optional: tuple[Topic[Any], ...] = (PRIOR,)
    join_timeout_s = 0.1

    def answer(self, joined: Joined) -> Message | Reason:
        return matches(joined.header, count=1 if joined.get(PRIOR) is None else 2)


class Plain:
    """A handler made of functions."""

    name = "rendering"
    inputs: tuple[Topic[Any], ...] = (GUESS,)
    outputs: tuple[Topic[Any], ...] = (GUESS,)

    def __init__(
        self,
        handle: Callable[[Topic[Any], Message], Iterable[Output]] = lambda topic, message: (),
        tick: Callable[[int], Iterable[Output]] = lambda now_ns: (),
        start: Callable[[], None] = lambda: None,
    ) -> None:
        self.handle, self.tick, self.start = handle, tick, start
        self.stopped = 0

    def stop(self) -> None:
        self.stopped += 1


class Several(Plain):
    """A handler that hears the guesses of two objects, and tells whose each is."""

    outputs: tuple[Topic[Any], ...] = (PRIOR,)

    def __init__(self, *objects: str) -> None:
        super().__init__(lambda topic, message: self.handle_of("itself", topic, message))
        self.objects, self.heard = objects, list[tuple[str, int]]()

    def handle_of(self, object: str, topic: Topic[Any], message: Message) -> Iterable[Output]:
        self.heard.append((object, message.header.frame_id))
        return [(PRIOR, prior(message.header.frame_id))]


@contextmanager
def running(handler: Handler, bus: MemoryBus, stats_period_s: float = 0.5) -> Iterator[threading.Thread]:
    stop = threading.Event()
    thread = threading.Thread(target=run_node, args=(handler, bus, ADDRESS, stop, stats_period_s))
    thread.start()
    try:
        wait_for(bus, ADDRESS, [handler.name], 5.0)
        yield thread
    finally:
        stop.set()
        thread.join(5.0)
        assert not thread.is_alive()


def listen(bus: MemoryBus, *topics: Topic[Any]) -> Inbox:
    return Inbox(bus, ADDRESS, topics)


def answer(inbox: Inbox) -> Matches:
    received = inbox.get(5.0)
    assert received is not None
    assert received.topic is MATCHES
    assert isinstance(received.message, Matches)
    return received.message


def refusal(inbox: Inbox) -> Failure:
    received = inbox.get(5.0)
    assert received is not None
    assert received.topic is FAILURE
    assert isinstance(received.message, Failure)
    return received.message


def only(outputs: Iterable[Output]) -> Message:
    """The one failure or result that a handler answers, on the topic that is its."""
    ((topic, message),) = outputs
    assert topic is (FAILURE if isinstance(message, Failure) else MATCHES)
    return message


def stats(inbox: Inbox) -> list[Stats]:
    return [item.message for item in inbox.drain() if isinstance(item.message, Stats)]


class TestJoined:
    @pytest.fixture
    def bus(self) -> MemoryBus:
        return MemoryBus()

    @pytest.fixture
    def ends(self, bus: MemoryBus) -> Iterator[tuple[Outbox, Inbox]]:
        inbox = listen(bus, MATCHES, FAILURE)
        with running(Matching(), bus):
            yield Outbox(bus, ADDRESS, "test"), inbox

    def test_joined_inputs_are_answered_under_the_same_frame_and_pass(self, ends: tuple[Outbox, Inbox]) -> None:
        outbox, inbox = ends
        for frame_id in (1, 2, 3):
            outbox.publish(FRAME, frame(frame_id))
        for frame_id, pass_index in ((3, 0), (1, 0), (3, 1)):
            outbox.publish(VIEW, view(frame_id, pass_index))
        answers = [answer(inbox) for _ in range(3)]
        assert [(each.header.frame_id, each.header.pass_index, len(each.confidence)) for each in answers] == [
            (3, 0, 3),
            (1, 0, 1),
            (3, 1, 3),
        ]
        assert [each.header.sequence for each in answers] == [0, 1, 2]
        assert {each.header.source for each in answers} == {"matching"}
        assert answers[0].header.capture_ns == 1003

    def test_it_sends_results_on_its_output_and_failures_on_theirs(self) -> None:
        assert Matching().outputs == (MATCHES, FAILURE)

    @pytest.mark.parametrize(
        ("frame_id", "reason"), [(12, Reason.TOO_FEW_MATCHES), (13, Reason.INTERNAL_ERROR)], ids=["reason", "exception"]
    )
    def test_a_reason_or_an_exception_is_one_failure_and_the_process_goes_on(
        self, ends: tuple[Outbox, Inbox], frame_id: int, reason: Reason
    ) -> None:
        outbox, inbox = ends
        for each, pass_index in ((frame_id, 1), (2, 0)):
            outbox.publish(FRAME, frame(each))
            outbox.publish(VIEW, view(each, pass_index))
        failed, good = refusal(inbox), answer(inbox)
        assert (failed.stage, failed.reason) == ("matching", reason)
        assert (failed.header.frame_id, failed.header.pass_index, failed.header.capture_ns) == (
            frame_id,
            1,
            1000 + frame_id,
        )
        assert (failed.header.source, failed.header.sequence) == ("matching", 0)
        assert (good.header.frame_id, good.header.sequence, len(good.confidence)) == (2, 0, 2)
        assert inbox.get(0.05) is None

    def test_an_exception_counts_as_failed_and_a_reason_does_not(self) -> None:
        handler = Matching()
        for frame_id in (12, 13):
            list(handler.handle(FRAME, frame(frame_id)))
            assert isinstance(only(handler.handle(VIEW, view(frame_id))), Failure)
        assert handler.failed == 1

    def test_a_frame_that_does_not_come_is_a_failure(self, ends: tuple[Outbox, Inbox]) -> None:
        outbox, inbox = ends
        started = time.monotonic()
        outbox.publish(VIEW, view(5, pass_index=1))
        failed = refusal(inbox)
        assert (failed.stage, failed.reason) == ("matching", Reason.FRAME_MISSING)
        assert (failed.header.frame_id, failed.header.pass_index) == (5, 1)
        assert time.monotonic() - started > 0.08
        assert inbox.get(0.05) is None

    def test_what_does_not_drive_is_never_answered(self, ends: tuple[Outbox, Inbox]) -> None:
        outbox, inbox = ends
        outbox.publish(FRAME, frame(5))
        assert inbox.get(0.3) is None

    def test_every_message_that_drives_is_answered_though_there_are_too_many_to_wait(self) -> None:
        handler = Matching()
        replies = [each for frame_id in range(200) for each in handler.handle(VIEW, view(frame_id))]
        replies += handler.tick(2**62)
        failed = [message for topic, message in replies if topic is FAILURE]
        assert [message.header.frame_id for message in failed] == list(range(200))
        assert {message.reason for message in failed if isinstance(message, Failure)} == {Reason.FRAME_MISSING}
        assert list(handler.tick(2**62)) == []

    def test_frames_are_kept_though_the_topic_is_newest_only(self, ends: tuple[Outbox, Inbox]) -> None:
        outbox, inbox = ends
        for frame_id in range(100, 164):
            outbox.publish(FRAME, frame(frame_id))
        for frame_id in (100, 130, 163):
            outbox.publish(VIEW, view(frame_id))
        assert [answer(inbox).header.frame_id for _ in range(3)] == [100, 130, 163]

    def test_exceptions_are_counted_and_logged_once_a_second(
        self, bus: MemoryBus, capsys: pytest.CaptureFixture[str]
    ) -> None:
        numbers = listen(bus, STATS)
        with running(Matching(), bus, stats_period_s=0.05):
            outbox = Outbox(bus, ADDRESS, "test")
            outbox.publish(FRAME, frame(13))
            for pass_index in range(12):
                outbox.publish(VIEW, view(13, pass_index))
            time.sleep(0.2)
        last = stats(numbers)[-1]
        assert (last.failed, last.received, last.published >= 12) == (12, 13, True)
        captured = capsys.readouterr()
        assert captured.out == ""
        assert captured.err.count("beyond me") == 1
        assert "test_node.py" in captured.err


class TestMissingInputs:
    """Of the view, its camera, its guess and its prior, the stage can do without the prior alone."""

    def reply(self, *given: Topic[Any], handler: JoinedHandler | None = None) -> Message:
        handler = handler or Lenient()
        samples = {VIEW: view(1), CAMERA_INFO: camera_info(1), GUESS: guess(1), PRIOR: prior(1), FRAME: frame(1)}
        early = [each for topic in given for each in handler.handle(topic, samples[topic])]
        late = list(handler.tick(2**62))
        assert not (early and late)
        assert bool(early) == (set(given) == set(handler.inputs))
        return only(early + late)

    def test_all_of_them_are_answered_at_once(self) -> None:
        answered = self.reply(CAMERA_INFO, GUESS, VIEW, PRIOR)
        assert isinstance(answered, Matches)
        assert len(answered.confidence) == 2

    def test_an_optional_one_is_waited_for_and_then_done_without(self) -> None:
        answered = self.reply(CAMERA_INFO, GUESS, VIEW)
        assert isinstance(answered, Matches)
        assert len(answered.confidence) == 1
        assert (answered.header.frame_id, answered.header.capture_ns) == (1, 1001)

    def test_an_optional_one_that_comes_in_time_is_used(self) -> None:
        handler = Lenient()
        for topic, message in ((VIEW, view(1)), (CAMERA_INFO, camera_info(1)), (GUESS, guess(1))):
            assert list(handler.handle(topic, message)) == []
        assert list(handler.tick(time.time_ns())) == []
        answered = only(handler.handle(PRIOR, prior(1)))
        assert isinstance(answered, Matches)
        assert len(answered.confidence) == 2
        assert list(handler.tick(2**62)) == []

    @pytest.mark.parametrize(
        "given", [(VIEW,), (VIEW, GUESS), (VIEW, CAMERA_INFO), (VIEW, GUESS, PRIOR), (VIEW, CAMERA_INFO, PRIOR)]
    )
    def test_one_that_is_needed_is_a_failure(self, given: tuple[Topic[Any], ...]) -> None:
        failed = self.reply(*given)
        assert isinstance(failed, Failure)
        assert (failed.stage, failed.reason, failed.header.frame_id) == ("pnp", Reason.INPUT_MISSING, 1)

    def test_a_frame_among_them_is_what_the_failure_tells(self) -> None:
        class Greedy(Lenient):
            inputs = (VIEW, GUESS, FRAME, PRIOR)

        for given, reason in (((VIEW,), Reason.FRAME_MISSING), ((VIEW, FRAME), Reason.INPUT_MISSING)):
            failed = self.reply(*given, handler=Greedy())
            assert isinstance(failed, Failure)
            assert failed.reason is reason

    def test_a_frame_may_be_optional(self) -> None:
        class Blind(Lenient):
            inputs = (VIEW, GUESS, FRAME)
            optional = (FRAME,)

        assert isinstance(self.reply(VIEW, GUESS, handler=Blind()), Matches)
        failed = self.reply(VIEW, handler=Blind())
        assert isinstance(failed, Failure)
        assert failed.reason is Reason.INPUT_MISSING

    def test_a_stage_that_takes_an_optional_one_for_granted_fails_as_by_any_exception(self) -> None:
        class Careless(Lenient):
            def answer(self, joined: Joined) -> Message | Reason:
                return matches(joined[PRIOR].header)

        handler = Careless()
        failed = self.reply(VIEW, CAMERA_INFO, GUESS, handler=handler)
        assert isinstance(failed, Failure)
        assert (failed.reason, handler.failed) == (Reason.INTERNAL_ERROR, 1)

    def test_a_process_does_without_an_optional_one_too(self) -> None:
        bus = MemoryBus()
        inbox = listen(bus, MATCHES, FAILURE)
        with running(Lenient(), bus):
            outbox = Outbox(bus, ADDRESS, "test")
            outbox.publish(CAMERA_INFO, camera_info(1))
            for pass_index in (0, 1):
                outbox.publish(GUESS, guess(1, pass_index))
                outbox.publish(VIEW, view(1, pass_index))
            answers = [answer(inbox) for _ in range(2)]
        assert [(each.header.pass_index, len(each.confidence)) for each in answers] == [(0, 1), (1, 1)]


class TestFailures:
    def test_several_processes_fail_on_one_topic_and_nobody_sees_a_gap(self) -> None:
        bus = MemoryBus()
        numbers, inbox = listen(bus, STATS), listen(bus, FAILURE)
        heard: list[Message] = []

        def hear(topic: Topic[Any], message: Message) -> Iterable[Output]:
            heard.append(message)
            return ()

        tracking = Plain(hear)
        tracking.name, tracking.inputs = "tracking", (FAILURE,)
        with running(tracking, bus, 0.05), running(Matching(), bus), running(Lenient(), bus):
            outbox = Outbox(bus, ADDRESS, "test")
            for frame_id in range(6):
                outbox.publish(VIEW, view(frame_id))
                outbox.publish(VIEW, view(frame_id, pass_index=1))
            received = [refusal(inbox) for _ in range(24)]
            time.sleep(0.1)
        for stage, reason in (("matching", Reason.FRAME_MISSING), ("pnp", Reason.INPUT_MISSING)):
            failures = [each for each in received if each.header.source == stage]
            assert [each.header.sequence for each in failures] == list(range(12))
            assert {(each.stage, each.reason) for each in failures} == {(stage, reason)}
        assert inbox.counts.gaps == 0
        assert len(heard) == 24
        assert [each for each in stats(numbers) if each.stage == "tracking"][-1].gaps == 0


class TestPlain:
    def test_one_that_hears_several_objects_is_told_whose_a_message_is_and_hears_no_others(self) -> None:
        bus, handler = MemoryBus(), Several("mug", "bowl")
        inbox = listen(bus, PRIOR)
        with running(handler, bus):
            for i, name in enumerate(("bowl", "cup", "mug", "bowl")):
                Outbox(bus, replace(ADDRESS, object=name), "test").publish(GUESS, guess(i))
            answered = [inbox.get(5.0) for _ in range(3)]
        assert handler.heard == [("bowl", 0), ("mug", 2), ("bowl", 3)]
        assert {each.key for each in answered if each is not None} == {ADDRESS.key(PRIOR)}

    def test_one_that_might_and_is_told_of_none_hears_its_own(self) -> None:
        bus, handler = MemoryBus(), Several()
        inbox = listen(bus, PRIOR)
        with running(handler, bus):
            for i, name in enumerate(("bowl", "mug")):
                Outbox(bus, replace(ADDRESS, object=name), "test").publish(GUESS, guess(i))
            assert inbox.get(5.0) is not None
        assert handler.heard == [("itself", 1)]

    def test_a_message_is_handled_at_once(self) -> None:
        bus = MemoryBus()
        delays_ms: list[float] = []

        def handle(topic: Topic[Any], message: Message) -> Iterable[Output]:
            delays_ms.append((time.time_ns() - message.header.sent_ns) / 1e6)
            return ()

        with running(Plain(handle), bus):
            outbox = Outbox(bus, ADDRESS, "test")
            for _ in range(30):
                outbox.publish(GUESS, guess())
                time.sleep(0.011)
        assert len(delays_ms) == 30
        assert sorted(delays_ms)[15] < 5.0

    def test_ticks_come_while_idle_and_while_messages_pour_in(self) -> None:
        bus = MemoryBus()
        ticks: list[float] = []

        def tick(now_ns: int) -> Iterable[Output]:
            ticks.append(now_ns / 1e9)
            return ()

        def pause(topic: Topic[Any], message: Message) -> Iterable[Output]:
            time.sleep(0.005)
            return ()

        with running(Plain(pause, tick), bus):
            time.sleep(0.3)
            idle, ticks[:] = list(ticks), []
            outbox = Outbox(bus, ADDRESS, "test")
            for _ in range(60):
                outbox.publish(GUESS, guess())
            time.sleep(0.3)
            busy = list(ticks)
        for times in (idle, busy):
            spaces = sorted(b - a for a, b in pairwise(times))
            assert len(times) >= 6
            assert spaces[len(spaces) // 2] < 0.04

    def test_a_source_sends_from_its_ticks_and_ends_by_itself(self) -> None:
        bus = MemoryBus()
        left = list(range(3))

        def tick(now_ns: int) -> Iterator[Output]:
            if not left:
                raise EndOfInput
            yield GUESS, guess(left.pop(0))

        inbox = listen(bus, GUESS)
        handler = Plain(tick=tick)
        run_node(handler, bus, ADDRESS)
        assert [item.message.header.frame_id for item in inbox.drain()] == [0, 1, 2]
        assert handler.stopped == 1
        assert bus.live(ADDRESS.live("*")) == set()

    def test_rubbish_on_the_wire_is_counted_logged_once_and_survived(self, capsys: pytest.CaptureFixture[str]) -> None:
        bus = MemoryBus()
        numbers, handled = listen(bus, STATS), []

        def handle(topic: Topic[Any], message: Message) -> Iterable[Output]:
            handled.append(message)
            return ()

        with running(Plain(handle), bus):
            for _ in range(10):
                bus.put(ADDRESS.key(GUESS), b"\xc1rubbish", GUESS)
            Outbox(bus, ADDRESS, "test").publish(GUESS, guess(5))
            time.sleep(0.1)
        assert len(handled) == 1
        assert stats(numbers)[-1].refused == 10
        assert capsys.readouterr().err.count("refused") == 1

    def test_gaps_are_counted(self) -> None:
        bus = MemoryBus()
        numbers = listen(bus, STATS)
        with running(Plain(), bus):
            outbox, nowhere = Outbox(bus, ADDRESS, "test"), Outbox(MemoryBus(), ADDRESS, "test")
            outbox.publish(GUESS, guess(0))
            outbox._bus = nowhere._bus
            for _ in range(3):
                outbox.publish(GUESS, guess(1))
            outbox._bus = bus
            outbox.publish(GUESS, guess(2))
            time.sleep(0.1)
        assert (stats(numbers)[-1].gaps, stats(numbers)) == (3, [])

    def test_an_answer_on_a_topic_that_is_no_output_is_a_failure(self) -> None:
        bus = MemoryBus()
        numbers = listen(bus, STATS, TRUTH)
        with running(Plain(lambda topic, message: [(TRUTH, message)]), bus):
            Outbox(bus, ADDRESS, "test").publish(GUESS, guess())
            time.sleep(0.1)
        items = numbers.drain()
        assert all(item.topic is STATS for item in items)
        assert isinstance(items[-1].message, Stats)
        assert items[-1].message.failed == 1


class Beating(Plain):
    """Wants to be called again after so long, and tells once it has been called five times."""

    def __init__(self, tick_in_s: float) -> None:
        super().__init__(tick=self.counted)
        self.wanted_s, self.ticks, self.five = tick_in_s, 0, threading.Event()

    def counted(self, now_ns: int) -> Iterable[Output]:
        self.ticks += 1
        if self.ticks == 5:
            self.five.set()
        return ()

    def tick_in_s(self, now_ns: int) -> float:
        return self.wanted_s


class TestKeepsTime:
    def test_a_handler_that_says_when_it_is_due_is_called_sooner_than_others(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(node, "TICK_S", 3600.0)
        handler, ticks = Beating(0.001), []
        with running(handler, MemoryBus()):
            assert handler.five.wait(10.0)
        with running(Plain(tick=lambda now_ns: ticks.append(now_ns) or ()), MemoryBus()):
            assert not threading.Event().wait(0.1)
        assert len(ticks) == 1

    def test_none_is_called_later_than_others_are(self) -> None:
        handler = Beating(3600.0)
        with running(handler, MemoryBus()):
            assert handler.five.wait(10.0)

    def test_only_handlers_that_can_say_it_are_asked(self) -> None:
        assert isinstance(Beating(0.0), KeepsTime)
        assert not isinstance(Plain(), KeepsTime)


class TestStats:
    def test_a_heartbeat_while_idle_and_not_ready_before_start_returns(self) -> None:
        bus = MemoryBus()
        numbers = listen(bus, STATS)
        seen_while_starting: list[Received] = []

        def start() -> None:
            seen_while_starting.extend(numbers.drain())
            assert bus.live(ADDRESS.live("*")) == set()

        with running(Plain(start=start), bus, stats_period_s=0.05):
            time.sleep(0.4)
            ready = stats(numbers)
        assert [item.message.ready for item in seen_while_starting] == [False]  # type: ignore[attr-defined]
        assert len(ready) >= 4
        assert all(each.ready and each.stage == "rendering" for each in ready)
        assert stats(numbers)[-1].ready is False
        assert ready[-1].rss_mb > 10
        assert ready[-1].cpu_s > 0

    def test_a_hung_loop_stops_the_heartbeat(self) -> None:
        bus = MemoryBus()
        numbers = listen(bus, STATS)
        release = threading.Event()

        def hang(topic: Topic[Any], message: Message) -> Iterable[Output]:
            release.wait(5.0)
            return ()

        with running(Plain(hang), bus, stats_period_s=0.05):
            Outbox(bus, ADDRESS, "test").publish(GUESS, guess())
            time.sleep(0.1)
            stats(numbers)
            time.sleep(0.2)
            assert stats(numbers) == []
            release.set()
            time.sleep(0.2)
            assert stats(numbers) != []

    def test_busy_time_is_that_of_work_that_was_answered(self) -> None:
        bus = MemoryBus()
        numbers = listen(bus, STATS)

        def work(topic: Topic[Any], message: Message) -> Iterator[Output]:
            if message.header.frame_id > 0:
                time.sleep(0.02)
                yield TRUTH, message

        handler = Plain(work)
        handler.outputs = (TRUTH,)
        handler.inputs = (GUESS,)
        with running(handler, bus):
            outbox = Outbox(bus, ADDRESS, "test")
            for frame_id in (0, 0, 0, 0, 1, 1):
                message = guess(frame_id)
                outbox.publish(GUESS, message)
            time.sleep(0.2)
        last = stats(numbers)[-1]
        assert 20 <= last.busy_ms_p50 <= last.busy_ms_p90 < 1000
        assert last.busy_s >= last.busy_ms_p50 / 1e3


STAGE = """
    import sys, time
    from fieldpose.bus.node import run_node
    from fieldpose.bus.topics import GUESS
    from fieldpose.bus.transport import ZenohBus
    from support.bus_samples import ADDRESS

    class Stage:
        name, inputs, outputs = "rendering", (GUESS,), ()
        def start(self):
            print("starting", flush=True)
            time.sleep(float(sys.argv[2]))
        def handle(self, topic, message):
            print("got", message.header.frame_id, flush=True)
            return ()
        def tick(self, now_ns):
            return ()
        def stop(self):
            print("stopped", flush=True)

    bus = ZenohBus(sys.argv[1])
    run_node(Stage(), bus, ADDRESS)
    bus.close()
"""


class TestProcesses:
    @pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
    @pytest.mark.parametrize("start_s", ["0", "60"])
    def test_a_signal_ends_it_cleanly_also_while_it_starts(
        self, hub: str, connect: Connect, spawn: Spawn, number: int, start_s: str
    ) -> None:
        process = spawn(STAGE, hub, start_s)
        assert process.stdout.readline() == "starting\n"
        if start_s == "0":
            wait_for(connect(hub), ADDRESS, ["rendering"], 30.0)
        process.send_signal(number)
        out, err = process.communicate(timeout=30.0)
        assert (process.returncode, out, err) == (0, "stopped\n", "")

    def test_killed_and_started_again(self, hub: str, connect: Connect, spawn: Spawn) -> None:
        bus = connect(hub)
        outbox = Outbox(bus, ADDRESS, "test")
        for frame_id in (1, 2):
            process = spawn(STAGE, hub, "0")
            wait_for(bus, ADDRESS, ["rendering"], 30.0)
            outbox.publish(GUESS, guess(frame_id))
            assert [process.stdout.readline() for _ in range(2)] == ["starting\n", f"got {frame_id}\n"]
            process.kill()
            process.wait()
            deadline = time.monotonic() + 30.0
            while bus.live(ADDRESS.live("rendering")) and time.monotonic() < deadline:
                time.sleep(0.01)
            assert bus.live(ADDRESS.live("rendering")) == set()

    def test_a_stage_that_cannot_start_ends_with_its_error(self) -> None:
        def start() -> None:
            raise RuntimeError("no field")

        handler = Plain(start=start)
        with pytest.raises(RuntimeError, match="no field"):
            run_node(handler, MemoryBus(), ADDRESS)
        assert handler.stopped == 1
