"""The life of a process: subscribe -> handle -> publish, with counters, heartbeat, liveliness token and signals.

A stage implements what stands in `handlers`; `run_node` does the rest.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from typing import Any

import numpy as np
import psutil

from fieldpose.bus.control import Desk
from fieldpose.bus.handlers import Controlled, EndOfInput, Handler, HearsObjects, JoinedHandler, KeepsTime, Output
from fieldpose.bus.joining import Joined, kept
from fieldpose.bus.logs import Throttle, describe, stage_logger
from fieldpose.bus.messages import Failure, Message, Reason, Stats
from fieldpose.bus.ports import Inbox, InboxCounts, Outbox, Received, first_header, reply_header
from fieldpose.bus.protocol import SETTLE_S, Bus, Closing
from fieldpose.bus.requests import Request, Response
from fieldpose.bus.signals import Interrupted, StopSignals
from fieldpose.bus.topics import FAILURE, STATS, Address, Topic
from fieldpose.errors import CodecError, FieldposeError

__all__ = [
    "Controlled", "EndOfInput", "Handler", "HearsObjects", "Joined", "JoinedHandler", "KeepsTime", "Output",
    "first_header", "reply_header", "run_node", "run_nodes",
]  # fmt: skip

TICK_S = 0.02
STATS_PERIOD_S = 0.5
_BUSY_WINDOW = 256


def run_node(
    handler: Handler,
    bus: Bus,
    address: Address,
    stop: threading.Event | None = None,
    stats_period_s: float = STATS_PERIOD_S,
) -> None:
    """Run `handler` until SIGTERM, SIGINT, `stop`, or EndOfInput; the bus stays open.

    An exception of `handler.start` is raised; one of `handle` or `tick` is counted, logged and survived.
    """
    run_nodes([(handler, address)], bus, stop, stats_period_s)


def run_nodes(
    handlers: Sequence[tuple[Handler, Address]],
    bus: Bus,
    stop: threading.Event | None = None,
    stats_period_s: float = STATS_PERIOD_S,
) -> None:
    """Run handlers of several pipelines as `run_node` does, in one thread, a message of each in turn.

    One that is at the end of its input leaves the others.
    """
    arrived = threading.Condition()
    nodes = [_Node(handler, bus, address, arrived, stats_period_s) for handler, address in handlers]
    with StopSignals(stop) as signals, ExitStack() as closing:
        for node in nodes:
            closing.callback(node.close)
            node.announce()
        # Settled first, for a recorder that runs already is to get this process's very first message, and to know it.
        bus.settle(SETTLE_S)
        with suppress(Interrupted, EndOfInput):
            with signals.raising():
                for node in nodes:
                    node.start()
            if not signals.stop.is_set():
                _open(nodes, bus)
                _serve(nodes, arrived, signals.stop)


def _open(nodes: Sequence[_Node], bus: Bus) -> None:
    """Listen, and once messages pass say that one is ready."""
    for node in nodes:
        node.listen()
    if not bus.settle(SETTLE_S, images=any(node.sends_images for node in nodes)):
        nodes[0].warn("someone on the bus does not answer")
    for node in nodes:
        node.be_ready()


def _serve(nodes: Sequence[_Node], arrived: threading.Condition, stop: threading.Event) -> None:
    serving = list(nodes)
    while serving and not stop.is_set():
        worked = False
        for node in list(serving):
            try:
                worked |= node.step()
            except EndOfInput:
                serving.remove(node)
                node.close()
        if not worked and serving:
            due = min(node.due for node in serving)
            with arrived:
                arrived.wait_for(lambda: any(node.has_some for node in serving), max(0.0, due - time.monotonic()))


class _Node:
    def __init__(
        self, handler: Handler, bus: Bus, address: Address, arrived: threading.Condition, stats_period_s: float
    ) -> None:
        self._handler = handler
        self._bus = bus
        self._address = address
        self._arrived = arrived
        self._stats_period_s = stats_period_s
        self._objects = handler.objects if isinstance(handler, HearsObjects) else ()
        self._outbox = Outbox(bus, address, handler.name)
        self._inbox: Inbox | None = None
        self._desk = Desk()
        self._served: Closing | None = None
        self._token: Closing | None = None
        self._announced: Closing | None = None
        self._closed = False
        self._throttle = Throttle(stage_logger(handler.name))
        self._failed = 0
        self._busy_ms: deque[float] = deque(maxlen=_BUSY_WINDOW)
        self._busy_s = 0.0
        self._process = psutil.Process()
        self._next_tick = self._next_stats = 0.0

    @property
    def sends_images(self) -> bool:
        return any(topic.priority == "data_low" for topic in self._handler.outputs)

    @property
    def due(self) -> float:
        """When it is to be called next, by the monotonic clock."""
        return min(self._next_tick, self._next_stats)

    @property
    def has_some(self) -> bool:
        """Whether a message waits for it."""
        return self._inbox is not None and self._inbox.has_some

    def announce(self) -> None:
        """Tell who sends from here."""
        self._announced = self._outbox.announce()

    def start(self) -> None:
        self._send_stats(ready=False)
        self._handler.start()

    def listen(self) -> None:
        joins = isinstance(self._handler, JoinedHandler)
        capacities = {topic: kept(topic) for topic in self._handler.inputs} if joins else None
        heard = replace(self._address, object="*") if self._objects else self._address
        inputs = self._handler.inputs
        self._inbox = Inbox(self._bus, heard, inputs, capacities, self._refused, self._arrived)
        if isinstance(self._handler, Controlled):
            self._served = self._bus.serve(self._address.control(self._handler.name), self._answer)

    def be_ready(self) -> None:
        self._token = self._bus.hold(self._address.live(self._handler.name))

    def warn(self, what: str) -> None:
        self._throttle.warning(what)

    def step(self) -> bool:
        """Handle a message if one waits, and do what is due; returns whether one did."""
        received = self._inbox.get(0.0) if self._inbox is not None else None
        if received is not None:
            self._run(lambda: self._handled(received))
        self._desk.work(self._carry_out)
        if time.monotonic() >= self._next_tick:
            self._run(lambda: self._handler.tick(time.time_ns()))
            self._next_tick = time.monotonic() + self._tick_in_s()
        if time.monotonic() >= self._next_stats:
            self._send_stats(ready=True)
        return received is not None

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        self._desk.close()
        for listening in (self._token, self._served, self._inbox):
            if listening is not None:
                listening.close()
        self._handler.stop()
        self._send_stats(ready=False)
        if self._announced is not None:
            self._announced.close()

    def _answer(self, payload: bytes) -> bytes:
        """Called from threads of the bus."""
        try:
            return self._desk.answer(payload)
        except FieldposeError as error:
            self._throttle.warning("refused", request=str(error))
            raise

    def _carry_out(self, request: Request[Any]) -> Response:
        assert isinstance(self._handler, Controlled)
        try:
            values, outputs = self._handler.control(request, time.time_ns())
        except FieldposeError:
            raise
        except Exception as error:
            self._note_failure(error)
            raise
        self._run(lambda: outputs)
        return values

    def _handled(self, received: Received) -> Iterable[Output]:
        if not isinstance(self._handler, HearsObjects) or not self._objects:
            return self._handler.handle(received.topic, received.message)
        sender = received.topic.address_of(received.key)
        if sender is None or sender.object not in self._objects:
            return ()
        return self._handler.handle_of(sender.object, received.topic, received.message)

    def _tick_in_s(self) -> float:
        if not isinstance(self._handler, KeepsTime):
            return TICK_S
        return min(TICK_S, self._handler.tick_in_s(time.time_ns()))

    def _run(self, work: Callable[[], Iterable[Output]]) -> None:
        """Publish what `work` answers; a call that answers nothing was no work and is not timed."""
        started = time.perf_counter()
        before = self._outbox.published
        try:
            for topic, message in work():
                if topic not in self._handler.outputs:
                    raise ValueError(f"{topic.name} is not among the outputs of {self._handler.name}")
                self._publish(topic, message)
        except EndOfInput:
            raise
        except Exception as error:
            self._note_failure(error)
        if self._outbox.published > before:
            self._busy_ms.append((time.perf_counter() - started) * 1e3)
            self._busy_s += self._busy_ms[-1] / 1e3

    def _publish(self, topic: Topic[Any], message: Message) -> None:
        """Send a message, or where that cannot be sent a Failure in its place; what else there is to send goes on."""
        try:
            self._outbox.publish(topic, message)
        except CodecError as error:
            self._note_failure(error)
            if FAILURE in self._handler.outputs and topic is not FAILURE:
                header = reply_header(message.header)
                failure = Failure(header=header, stage=self._handler.name, reason=Reason.INTERNAL_ERROR)
                self._outbox.publish(FAILURE, failure)

    def _note_failure(self, error: Exception) -> None:
        self._failed += 1
        self._throttle.warning("failed", error=describe(error))

    def _refused(self, topic: Topic[Any], error: CodecError) -> None:
        self._throttle.warning("refused", topic=topic.name, error=str(error))

    def _send_stats(self, ready: bool) -> None:
        self._next_stats = time.monotonic() + self._stats_period_s
        try:
            self._outbox.publish(STATS, self._stats(ready))
        except CodecError as error:
            self._note_failure(error)

    def _stats(self, ready: bool) -> Stats:
        counts = self._inbox.counts if self._inbox is not None else InboxCounts()
        times = self._process.cpu_times()
        p50, p90 = np.percentile(self._busy_ms, (50, 90)) if self._busy_ms else (0.0, 0.0)
        return Stats(
            header=first_header(0, time.time_ns()),
            stage=self._handler.name,
            ready=ready,
            received=counts.received,
            published=self._outbox.published,
            refused=counts.refused + self._desk.refused,
            gaps=counts.gaps,
            skipped=counts.skipped,
            failed=self._failed + (self._handler.failed if isinstance(self._handler, JoinedHandler) else 0),
            busy_ms_p50=float(p50),
            busy_ms_p90=float(p90),
            cpu_s=times.user + times.system,
            rss_mb=self._process.memory_info().rss / 2**20,
            busy_s=self._busy_s,
        )
