"""Bytes there and back over the bus, between two sessions of one process or of two."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator

from fieldpose.bus.topics import VIEW, Address
from fieldpose.bus.transport import Bus, ZenohBus, serve_hub, wait_for
from fieldpose.deploy.processes.endpoints import free_port
from fieldpose.errors import TransportError

WAITING = 64
_HERE = Address()
_ANSWERING = "echo"
_THERE, _BACK = "fieldpose/echo/there", "fieldpose/echo/back"
_NUMBER_BYTES = 8
_MEETING_S, _ANSWER_S = 20.0, 2.0


@contextlib.contextmanager
def hub() -> Iterator[str]:
    """A hub on a free port of the loopback interface; its endpoint."""
    endpoint, stop = f"tcp/127.0.0.1:{free_port()}", threading.Event()
    serving = threading.Thread(target=serve_hub, args=(endpoint, None, stop), daemon=True)
    serving.start()
    try:
        yield endpoint
    finally:
        stop.set()
        serving.join()


@contextlib.contextmanager
def session(endpoint: str) -> Iterator[ZenohBus]:
    """A session with a hub. Raises TransportError where that does not answer."""
    bus = ZenohBus(endpoint)
    try:
        bus.wait_for_hub(_MEETING_S)
        yield bus
    finally:
        bus.close()


def answer(bus: Bus, seen: Callable[[bytes, int], object] = lambda payload, at_ns: None) -> None:
    """Send back what an `Echo` in another session sends, after `seen` was told of it and of when it came."""

    def heard(key: str, payload: bytes, at_ns: int) -> None:
        seen(payload, at_ns)
        bus.put(_BACK, payload, VIEW)

    bus.subscribe(_THERE, heard, WAITING)
    bus.hold(_HERE.live(_ANSWERING))


class Echo:
    """Sends numbered payloads to who answers them; `sent_ns`: when each was sent, since the epoch.

    Raises TransportError where nobody does.
    """

    def __init__(self, bus: Bus) -> None:
        self.sent_ns: dict[int, int] = {}
        self._bus, self._number, self._came = bus, 0, threading.Event()
        bus.subscribe(_BACK, self._heard, WAITING)
        wait_for(bus, _HERE, [_ANSWERING], _MEETING_S)
        if not bus.settle(_MEETING_S, images=True):
            raise TransportError("nothing comes back over the bus")

    def round_trip_ms(self, size: int) -> float | None:
        """Time until so many bytes are back; None where they are lost."""
        self._number += 1
        payload = numbered(self._number, size)
        self._came.clear()
        self.sent_ns[self._number] = time.time_ns()
        began = time.perf_counter()
        self._bus.put(_THERE, payload, VIEW)
        return (time.perf_counter() - began) * 1e3 if self._came.wait(_ANSWER_S) else None

    def _heard(self, key: str, payload: bytes, at_ns: int) -> None:
        if number_of(payload) == self._number:
            self._came.set()


def numbered(number: int, size: int) -> bytes:
    """A payload of so many bytes, at least 8, that begins with its number."""
    return number.to_bytes(_NUMBER_BYTES, "big") + bytes(size - _NUMBER_BYTES)


def number_of(payload: bytes) -> int:
    """What `numbered` was given."""
    return int.from_bytes(payload[:_NUMBER_BYTES], "big")
