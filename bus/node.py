"""The life of a process: subscribe -> handle -> publish, with counters, heartbeat, liveliness token and signals.

A stage implements what stands in `handlers`; `run_node` does the rest.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import psutil

from fieldpose.bus.control import Desk
from fieldpose.bus.handlers import Controlled, EndOfInput, Handler, JoinedHandler, KeepsTime, Output
from fieldpose.bus.joining import Joined, kept
from fieldpose.bus.logs import Throttle, describe, stage_logger
from fieldpose.bus.messages import Failure, Message, Reason, Stats
from fieldpose.bus.ports import Inbox, InboxCounts, Outbox, first_header, reply_header
from fieldpose.bus.protocol import SETTLE_S, Bus, Closer, Closing
from fieldpose.bus.requests import ControlValues, Request
from fieldpose.bus.signals import Interrupted, StopSignals
from fieldpose.bus.topics import FAILURE, STATS, Address, Topic
from fieldpose.errors import CodecError, FieldposeError

__all__ = [
    "Controlled", "EndOfInput", "Handler", "Joined", "JoinedHandler", "KeepsTime", "Output", "first_header",
    "reply_header", "run_node",
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
    with StopSignals(stop) as signals:
        _Node(handler, bus, address, signals.stop, stats_period_s).run(signals)


class _Node:
    def __init__(
        self, handler: Handler, bus: Bus, address: Address, stop: threading.Event, stats_period_s: float
    ) -> None:
        self._handler = handler
        self._bus = bus
        self._address = address
        self._stop = stop
        self._stats_period_s = stats_period_s
        self._outbox = Outbox(bus, address, handler.name)
        self._inbox: Inbox | None = None
        self._desk = Desk()
        self._throttle = Throttle(stage_logger(handler.name))
        self._failed = 0
        self._busy_ms: deque[float] = deque(maxlen=_BUSY_WINDOW)
        self._busy_s = 0.0
        self._process = psutil.Process()
        self._next_tick = self._next_stats = 0.0

    def run(self, signals: StopSignals) -> None:
        # Settled first, for a recorder that runs already is to get this process's very first message.
        self._bus.settle(SETTLE_S)
        self._send_stats(ready=False)
        try:
            signals.interrupting = True
            if not self._stop.is_set():
                self._handler.start()
            signals.interrupting = False
            if not self._stop.is_set():
                self._serve()
        except (Interrupted, EndOfInput):
            pass
        finally:
            signals.interrupting = False
            self._handler.stop()
            self._send_stats(ready=False)

    def _serve(self) -> None:
        joins = isinstance(self._handler, JoinedHandler)
        capacities = {topic: kept(topic) for topic in self._handler.inputs} if joins else None
        self._inbox = Inbox(self._bus, self._address, self._handler.inputs, capacities, self._refused)
        served = self._open_desk()
        if not self._bus.settle(SETTLE_S, images=any(topic.priority == "data_low" for topic in self._handler.outputs)):
            self._throttle.warning("someone on the bus does not answer")
        token = self._bus.hold(self._address.live(self._handler.name))
        try:
            while not self._stop.is_set():
                self._step(self._inbox)
        finally:
            token.close()
            self._desk.close()
            served.close()
            self._inbox.close()

    def _open_desk(self) -> Closing:
        if not isinstance(self._handler, Controlled):
            return Closer(lambda: None)
        return self._bus.serve(self._address.control(self._handler.name), self._answer)

    def _answer(self, payload: bytes) -> bytes:
        """Called from threads of the bus."""
        try:
            return self._desk.answer(payload)
        except FieldposeError as error:
            self._throttle.warning("refused", request=str(error))
            raise

    def _carry_out(self, request: Request) -> ControlValues:
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

    def _step(self, inbox: Inbox) -> None:
        received = inbox.get(max(0.0, min(self._next_tick, self._next_stats) - time.monotonic()))
        if received is not None:
            self._run(lambda: self._handler.handle(received.topic, received.message))
        self._desk.work(self._carry_out)
        if time.monotonic() >= self._next_tick:
            self._run(lambda: self._handler.tick(time.time_ns()))
            self._next_tick = time.monotonic() + self._tick_in_s()
        if time.monotonic() >= self._next_stats:
            self._send_stats(ready=True)

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
        self._outbox.publish(STATS, self._stats(ready))

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
