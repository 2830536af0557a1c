"""Requests to a running stage: carried out in its own thread, refused in one line, over every bus."""

from __future__ import annotations

import subprocess
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import msgpack
import pytest
import zenoh
from support.bus_samples import ADDRESS, camera_info, guess

from fieldpose.bus import node
from fieldpose.bus.codec import encode
from fieldpose.bus.control import MOST_WAITING, Desk, ask_one, ask_stage
from fieldpose.bus.messages import Message, Stats, TrackingState
from fieldpose.bus.node import Controlled, Output, run_node
from fieldpose.bus.ports import Inbox, Outbox
from fieldpose.bus.requests import ControlValues, Request, Reset, SetSolving, Show, decode_answer
from fieldpose.bus.topics import CAMERA_INFO, GUESS, STATS, Address, Topic
from fieldpose.bus.transport import Bus, MemoryBus, ZenohBus, wait_for
from fieldpose.errors import FieldposeError, RefusedError, TransportError

Sessions = tuple[Bus, Bus]
Connect = Callable[[str], ZenohBus]
Spawn = Callable[..., "subprocess.Popen[str]"]
ENOUGH_S = 20.0


def values(requests: int = 0, solves_per_s: float | None = None) -> ControlValues:
    return ControlValues(
        state=TrackingState.TRACKING, frames=0, requests=requests, solves_per_s=solves_per_s, begins_at=None
    )


class Quiet:
    """A stage that takes no requests."""

    name = "tracking"
    inputs: tuple[Topic[Any], ...] = (CAMERA_INFO,)
    outputs: tuple[Topic[Any], ...] = (GUESS,)

    def __init__(self, handle: Callable[[], None] = lambda: None) -> None:
        self.solves_per_s, self.requests = 0.0, 0
        self.threads: set[int] = set()
        self._handled = handle

    def start(self) -> None: ...

    def stop(self) -> None: ...

    def tick(self, now_ns: int) -> Iterable[Output]:
        self.threads.add(threading.get_ident())
        return ()

    def handle(self, topic: Topic[Any], message: Message) -> Iterable[Output]:
        self._handled()
        return ()


class Dial(Quiet):
    """A stage with one value: it cannot be reset, breaks at 13, and says a message for each change."""

    def control(self, request: Request[Any], now_ns: int) -> tuple[ControlValues, Iterable[Output]]:
        self.threads.add(threading.get_ident())
        if isinstance(request, Reset):
            raise RefusedError("there is nothing\n to reset")
        if not isinstance(request, SetSolving):
            return values(self.requests, self.solves_per_s), ()
        if request.solves_per_s == 13:
            raise RuntimeError("beyond me")
        self.solves_per_s, self.requests = request.solves_per_s, self.requests + 1
        return values(self.requests, self.solves_per_s), [(GUESS, guess(self.requests))]


@contextmanager
def running(handler: Any, bus: Bus, address: Address = ADDRESS) -> Iterator[None]:
    stop = threading.Event()
    thread = threading.Thread(target=run_node, args=(handler, bus, address, stop, 0.02))
    thread.start()
    try:
        wait_for(bus, address, [handler.name], ENOUGH_S)
        yield
    finally:
        stop.set()
        thread.join(ENOUGH_S)
        assert not thread.is_alive()


def ask(bus: Bus, request: Request[Any], address: Address = ADDRESS) -> ControlValues:
    return ask_one(bus, address, "tracking", request, ENOUGH_S)


class TestBus:
    """What a bus does with questions, whatever they are."""

    def test_an_answer_and_a_refusal_come_back(self, sessions: Sessions) -> None:
        def answer(payload: bytes) -> bytes:
            if payload == b"no":
                raise RefusedError("not\nthat")
            if payload == b"oh":
                raise KeyError("x")
            return payload + b"!"

        asker, server = sessions
        serving = server.serve("a/b", answer)
        assert asker.ask("a/b", b"hi", ENOUGH_S).answers == {"a/b": b"hi!"}
        assert asker.ask("a/b", b"", ENOUGH_S).answers == {"a/b": b"!"}
        refused = asker.ask("a/b", b"no", ENOUGH_S)
        assert (refused.answers, refused.refusals) == ({}, ("a/b: not that",))
        assert asker.ask("a/b", b"oh", ENOUGH_S).refusals == ("a/b: failed: KeyError: 'x'",)
        serving.close()
        with pytest.raises(TransportError, match=r"nobody answers at a/b after 0\.1 s; is that pipeline running"):
            asker.ask("a/b", b"hi", 0.1)

    def test_all_who_serve_a_pattern_answer(self, sessions: Sessions) -> None:
        def refuse(payload: bytes) -> bytes:
            raise RefusedError("no")

        asker, server = sessions
        for key in ("a/1", "a/2"):
            server.serve(key, lambda payload, key=key: key.encode())
        server.serve("a/3", refuse)
        server.serve("b/1", lambda payload: b"other")
        asker.ask("b/1", b"", ENOUGH_S)  # so that all of them are known
        replies = asker.ask("a/*", b"", ENOUGH_S)
        assert replies.answers == {"a/1": b"a/1", "a/2": b"a/2"}
        assert replies.refusals == ("a/3: no",)

    def test_one_question_does_not_wait_for_another(self, connect: Connect, hub: str) -> None:
        asker, server, release = connect(hub), connect(hub), threading.Event()

        def answer(payload: bytes) -> bytes:
            if payload == b"slow":
                release.wait(ENOUGH_S)
            return payload

        server.serve("a/b", answer)
        assert asker.ask("a/b", b"quick", ENOUGH_S).answers == {"a/b": b"quick"}
        slow: list[Any] = []
        thread = threading.Thread(target=lambda: slow.append(asker.ask("a/b", b"slow", ENOUGH_S)))
        thread.start()
        assert asker.ask("a/b", b"quick", ENOUGH_S).answers == {"a/b": b"quick"}
        release.set()
        thread.join(ENOUGH_S)
        assert slow[0].answers == {"a/b": b"slow"}

    def test_who_does_not_answer_in_time_is_nobody(self, connect: Connect, hub: str) -> None:
        asker, server, release = connect(hub), connect(hub), threading.Event()
        asked: list[bytes] = []

        def answer(payload: bytes) -> bytes:
            asked.append(payload)
            release.wait(ENOUGH_S)
            return payload

        serving = server.serve("a/b", answer)
        try:
            while not asked:
                with pytest.raises(TransportError, match="nobody answers"):
                    asker.ask("a/b", b"", 0.2)
        finally:
            release.set()
            serving.close()


class TestNode:
    def test_a_request_is_answered_by_the_stages_own_thread(self, sessions: Sessions) -> None:
        asker, server = sessions
        dial, said = Dial(), Inbox(asker, ADDRESS, [GUESS])
        with running(dial, server):
            assert ask(asker, SetSolving(solves_per_s=2.0)).solves_per_s == 2.0
            shown = ask(asker, Show())
            assert (shown.requests, shown.solves_per_s) == (1, 2.0)
            received = said.get(ENOUGH_S)
            assert received is not None
            assert received.message.header.source == "tracking"
        assert len(dial.threads) == 1
        with pytest.raises(TransportError, match="nobody answers at test/control/mug/cam/tracking"):
            ask_one(asker, ADDRESS, "tracking", Show(), 0.1)

    def test_it_can_be_asked_as_soon_as_it_is_ready(self) -> None:
        bus = MemoryBus()
        with running(Dial(), bus):
            assert ask(bus, Show()).requests == 0

    def test_a_stage_that_takes_no_requests_has_nobody_to_ask(self) -> None:
        bus = MemoryBus()
        with running(Quiet(), bus), pytest.raises(TransportError, match="nobody answers"):
            ask_one(bus, ADDRESS, "tracking", Show(), 0.1)
        assert (isinstance(Dial(), Controlled), isinstance(Quiet(), Controlled)) == (True, False)

    def test_a_refusal_changes_nothing_and_is_counted(self, sessions: Sessions) -> None:
        asker, server = sessions
        numbers = Inbox(asker, ADDRESS, [STATS])
        with running(Dial(), server):
            with pytest.raises(RefusedError, match="test/control/mug/cam/tracking: there is nothing to reset"):
                ask(asker, Reset())
            for payload, why in (
                (b"\xc1", "request: "),
                (b"", "request: "),
                (msgpack.packb({"request": "show", "version": 9}), "version 9 where 1 is expected"),
                (bytes(9000), "9000 bytes where at most 4096 are allowed"),
                (msgpack.packb({"request": "set_solving", "version": 1, "solves_per_s": 1e9}), "where 0 to 100"),
            ):
                replies = asker.ask(ADDRESS.control("tracking"), payload, ENOUGH_S)
                assert replies.answers == {}
                (line,) = replies.refusals
                assert why in line
                assert "\n" not in line
            with pytest.raises(RefusedError, match="failed: RuntimeError: beyond me"):
                ask(asker, SetSolving(solves_per_s=13.0))
            shown = ask(asker, Show())
            assert (shown.requests, shown.solves_per_s) == (0, 0.0)
        last = [item.message for item in numbers.drain() if isinstance(item.message, Stats)][-1]
        assert (last.refused, last.failed) == (7, 1)

    def test_each_pipeline_answers_for_itself(self, sessions: Sessions) -> None:
        asker, server = sessions
        other = Address("test", "cup", "cam")
        with running(Dial(), server), running(Dial(), server, other):
            ask(asker, SetSolving(solves_per_s=3.0), other)
            everyone = Address("test", "*", "*")
            answers, refusals = ask_stage(asker, everyone, "tracking", Show(), ENOUGH_S)
            assert {key: each.solves_per_s for key, each in answers.items()} == {
                ADDRESS.control("tracking"): 0.0, other.control("tracking"): 3.0,
            }  # fmt: skip
            assert refusals == []
            assert len(ask_stage(asker, everyone, "tracking", Reset(), ENOUGH_S)[1]) == 2
            with pytest.raises(TransportError, match="2 pipelines answer"):
                ask(asker, Show(), everyone)

    def test_a_request_that_waits_too_long_is_refused_and_never_carried_out(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        begun, release, bus = threading.Event(), threading.Event(), MemoryBus()

        def hang() -> None:
            begun.set()
            release.wait(ENOUGH_S)

        monkeypatch.setattr(node, "Desk", lambda: Desk(0.05))
        with running(Dial(hang), bus):
            Outbox(bus, ADDRESS, "test").publish(CAMERA_INFO, camera_info())
            assert begun.wait(ENOUGH_S)
            try:
                with pytest.raises(RefusedError, match=r"has had no time for 0\.05 s, and nothing was done; ask again"):
                    ask(bus, SetSolving(solves_per_s=2.0))
            finally:
                release.set()
            while True:  # it is at work again
                answers, _ = ask_stage(bus, ADDRESS, "tracking", Show(), ENOUGH_S)
                if answers:
                    break
            assert [each.requests for each in answers.values()] == [0]


class TestDesk:
    def test_so_many_wait_and_one_more_is_refused(self) -> None:
        desk, answered = Desk(ENOUGH_S), []
        threads = [
            threading.Thread(target=lambda: answered.append(desk.answer(encode(Show())))) for _ in range(MOST_WAITING)
        ]
        for thread in threads:
            thread.start()
        while len(desk._waiting) < MOST_WAITING:
            time.sleep(0.001)
        with pytest.raises(RefusedError, match="8 requests wait already; ask again"):
            desk.answer(encode(Show()))
        desk.work(lambda request: values(5))
        for thread in threads:
            thread.join(ENOUGH_S)
        assert [decode_answer(payload, Show()).requests for payload in answered] == [5] * MOST_WAITING
        assert desk.refused == 1

    def test_when_it_closes_what_waits_is_refused_and_what_comes(self) -> None:
        desk, errors = Desk(ENOUGH_S), []

        def ask_it() -> None:
            try:
                desk.answer(encode(Show()))
            except FieldposeError as error:
                errors.append(str(error))

        thread = threading.Thread(target=ask_it)
        thread.start()
        while not desk._waiting:
            time.sleep(0.001)
        desk.close()
        thread.join(ENOUGH_S)
        ask_it()
        assert errors == ["it is ending; ask again once it has started again"] * 2

    def test_what_is_being_carried_out_is_answered_however_long_that_takes(self) -> None:
        """And what was refused is never carried out, whichever of the two comes first."""
        desk, done, answered = Desk(0.01), [], []

        def slowly(request: Request[Any]) -> ControlValues:
            time.sleep(0.03)
            done.append(request)
            return values(len(done))

        def ask_it() -> None:
            with suppress(RefusedError):
                answered.append(decode_answer(desk.answer(encode(Show())), Show()).requests)

        while len(answered) < 3:
            thread = threading.Thread(target=ask_it)
            thread.start()
            while thread.is_alive():
                desk.work(slowly)
        assert len(done) == len(answered)


STAGE = """
    import sys
    from fieldpose.bus.node import run_node
    from fieldpose.bus.transport import ZenohBus
    from support.bus_samples import ADDRESS
    sys.path.insert(0, sys.argv[2])
    from test_control import Dial

    bus = ZenohBus(sys.argv[1])
    run_node(Dial(), bus, ADDRESS)
    bus.close()
"""


def test_a_plain_zenoh_client_asks_a_stage_in_another_process(
    hub: str, connect: Connect, spawn: Spawn, request: pytest.FixtureRequest
) -> None:
    process = spawn(STAGE, hub, str(request.path.parent))
    wait_for(connect(hub), ADDRESS, ["tracking"], ENOUGH_S)
    config = zenoh.Config()
    for path, value in {
        "mode": '"client"', "connect/endpoints": f'["{hub}"]', "scouting/multicast/enabled": "false",
    }.items():  # fmt: skip
        config.insert_json5(path, value)
    with zenoh.open(config) as session:
        key = "test/control/mug/cam/tracking"

        def said(**fields: Any) -> Any:
            replies: list[Any] = []
            while not replies:  # until the client knows of the stage
                replies = list(session.get(key, payload=msgpack.packb(fields), timeout=ENOUGH_S))
            (reply,) = replies
            return reply

        good = said(request="set_solving", version=1, solves_per_s=4)
        assert str(good.ok.key_expr) == key
        assert msgpack.unpackb(good.ok.payload.to_bytes())["solves_per_s"] == 4.0
        bad = said(request="set_solving", version=1, solves_per_s=-4)
        assert bad.ok is None
        assert bad.err.payload.to_string() == f"{key}: SetSolving: solves_per_s: -4 where 0 to 100 is expected"
        assert msgpack.unpackb(said(request="show", version=1).ok.payload.to_bytes())["solves_per_s"] == 4.0
    process.terminate()
    process.communicate(timeout=ENOUGH_S)
    assert process.returncode == 0
