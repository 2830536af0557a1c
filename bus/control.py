"""Requests to a running stage: they wait for the stage's own thread, and are answered or refused in one line."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from fieldpose.bus.codec import encode
from fieldpose.bus.protocol import Bus
from fieldpose.bus.requests import R, Request, Response, decode_answer, decode_request
from fieldpose.bus.topics import Address
from fieldpose.errors import FieldposeError, RefusedError, TransportError

PATIENCE_S = 2.0
MOST_WAITING = 8


@dataclass(eq=False)
class _Waiting:
    request: Request[Any]
    done: threading.Event = field(default_factory=threading.Event)
    values: Response | None = None
    error: Exception | None = None


class Desk:
    """Where requests wait, at most so many and so long, until `work` is called.

    patience_s: how long; one that is being carried out by then is not refused any more.
    """

    def __init__(self, patience_s: float = PATIENCE_S) -> None:
        self.refused = 0
        self._patience_s = patience_s
        self._lock = threading.Lock()
        self._waiting: deque[_Waiting] = deque()
        self._open = True

    def answer(self, payload: bytes) -> bytes:
        """The encoded answer to an encoded request, from any thread. Raises FieldposeError where it is refused."""
        try:
            waiting = self._enter(decode_request(payload))
            if not waiting.done.wait(self._patience_s):
                self._leave(waiting)
            return _outcome(waiting)
        except Exception:
            with self._lock:
                self.refused += 1
            raise

    def work(self, carry_out: Callable[[Request[Any]], Response]) -> None:
        """Carry out, in this thread, what waits. An exception goes to who has asked."""
        while True:
            with self._lock:
                if not self._waiting:
                    return
                waiting = self._waiting.popleft()
            try:
                waiting.values = carry_out(waiting.request)
            except Exception as error:
                waiting.error = error
            waiting.done.set()

    def close(self) -> None:
        """Refuse what waits, and what will."""
        with self._lock:
            self._open, left = False, list(self._waiting)
            self._waiting.clear()
        for waiting in left:
            waiting.error = RefusedError("it is ending; ask again once it has started again")
            waiting.done.set()

    def _enter(self, request: Request[Any]) -> _Waiting:
        waiting = _Waiting(request)
        with self._lock:
            if not self._open:
                raise RefusedError("it is ending; ask again once it has started again")
            if len(self._waiting) >= MOST_WAITING:
                raise RefusedError(f"{MOST_WAITING} requests wait already; ask again in a moment")
            self._waiting.append(waiting)
        return waiting

    def _leave(self, waiting: _Waiting) -> None:
        with self._lock:
            if waiting in self._waiting:
                self._waiting.remove(waiting)
                raise RefusedError(f"it has had no time for {self._patience_s:g} s, and nothing was done; ask again")
        waiting.done.wait()


def _outcome(waiting: _Waiting) -> bytes:
    if waiting.error is not None:
        raise waiting.error
    assert waiting.values is not None
    return encode(waiting.values)


def ask_stage(
    bus: Bus, address: Address, stage: str, request: Request[R], timeout_s: float
) -> tuple[dict[str, R], list[str]]:  # fmt: skip
    """Ask a stage of each pipeline that `address` stands for: its answer by its key, and the refusals, a line each.

    Raises CodecError for a request that cannot be sent, and TransportError where nobody answers in time.
    """
    replies = bus.ask(address.control(stage), encode(request), timeout_s)
    values, refusals = {}, list(replies.refusals)
    for key, payload in sorted(replies.answers.items()):
        try:
            values[key] = decode_answer(payload, request)
        except FieldposeError as error:
            refusals.append(f"{key}: an answer that cannot be read: {error}")
    return values, refusals


def ask_one(bus: Bus, address: Address, stage: str, request: Request[R], timeout_s: float) -> R:
    """Ask the stage of one pipeline. Raises RefusedError, and what `ask_stage` raises."""
    values, refusals = ask_stage(bus, address, stage, request, timeout_s)
    if refusals:
        raise RefusedError("; ".join(refusals))
    if len(values) != 1:
        raise TransportError(f"{len(values)} pipelines answer at {address.control(stage)} where one is expected")
    return next(iter(values.values()))
