"""Knowing that messages pass between this session and every other one, both ways.

A liveliness token may come by way of the hub before two peers have a link of their own, and what is sent then is
lost without a word. So each session answers the greetings of the others: an answer that arrives has come over the
link itself, after everything that its sender declared before.
"""

from __future__ import annotations

import threading
import time

from bus.protocol import Bus

_AGAIN_S = 0.02
# More than the size from which a message goes through shared memory, which takes a while to set up the first time.
_IMAGE = bytes(8192)


class Greeter:
    """Answers greetings on `bus` under the session's `name`, and greets the others on demand."""

    def __init__(self, bus: Bus, name: str) -> None:
        self._bus = bus
        self._name = name
        self._answered: set[str] = set()
        self._changed = threading.Condition()
        bus.subscribe(f"peers/answer/{name}/*", self._take_answer, 64)
        bus.subscribe("peers/greeting/*", self._answer, 64)
        bus.hold(f"peers/live/{name}")

    def settle(self, timeout_s: float, images: bool) -> bool:
        """Greet until every session that is on the bus has answered; False where some did not in time."""
        with self._changed:
            self._answered.clear()
        deadline = time.monotonic() + timeout_s
        while True:
            others = {key.rsplit("/", 1)[1] for key in self._bus.live("peers/live/*")} - {self._name}
            with self._changed:
                if others <= self._answered:
                    return True
                if time.monotonic() > deadline:
                    return False
            self._bus.put(f"peers/greeting/{self._name}", _IMAGE if images else b"")
            with self._changed:
                self._changed.wait_for(lambda others=others: others <= self._answered, _AGAIN_S)  # type: ignore[misc]

    def _take_answer(self, key: str, payload: bytes, received_ns: int) -> None:
        with self._changed:
            self._answered.add(key.rsplit("/", 1)[1])
            self._changed.notify()

    def _answer(self, key: str, payload: bytes, received_ns: int) -> None:
        greeter = key.rsplit("/", 1)[1]
        if greeter != self._name:
            self._bus.put(f"peers/answer/{greeter}/{self._name}", b"")
