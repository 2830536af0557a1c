"""Carrying bytes between processes: the Bus protocol, and MemoryBus, which does it inside one process."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Protocol, TypeVar

from bus.errors import TransportError
from bus.topics import Address, Topic

T = TypeVar("T")

Sink = Callable[[str, bytes, int], None]
"""Takes (key, payload, time of receipt in ns); is called from the bus's own threads and returns at once."""

Watcher = Callable[[str, bool], None]
"""Takes (key, alive) of a liveliness token that appeared or disappeared."""


class Closing(Protocol):
    """Something that was declared on a bus and ends with `close`."""

    def close(self) -> None: ...


class Bus(Protocol):
    """Bytes by key, and tokens that live as long as their process; a "*" in a key listens to any one part."""

    def put(self, key: str, payload: bytes, topic: Topic) -> None:
        """Send with the topic's priority and congestion control; nobody says whether it was received."""

    def subscribe(self, key: str, sink: Sink, capacity: int) -> Closing:
        """Give what arrives to `sink`; while that is held up, `capacity` messages wait (1: the newest)."""

    def hold(self, key: str) -> Closing:
        """Hold a liveliness token until closed, or until this process dies."""

    def live(self, key: str) -> set[str]:
        """The tokens held now by anyone."""

    def watch(self, key: str, watcher: Watcher) -> Closing:
        """Tell `watcher` of the tokens held now and of each change."""

    def close(self) -> None: ...


@dataclass
class _Room:
    """What MemoryBus sessions share; sinks and watchers are called from the thread that puts."""

    lock: threading.RLock = field(default_factory=threading.RLock)
    sinks: list[tuple[str, Sink]] = field(default_factory=list)
    tokens: list[str] = field(default_factory=list)
    watchers: list[tuple[str, Watcher]] = field(default_factory=list)


class _Closer:
    """Runs its action the first time that it is closed."""

    def __init__(self, action: Callable[[], None]) -> None:
        self._action: Callable[[], None] | None = action

    def close(self) -> None:
        action, self._action = self._action, None
        if action is not None:
            action()


class MemoryBus:
    """A bus between the threads of one process; a second session joins the first as its neighbour."""

    def __init__(self, neighbour: MemoryBus | None = None) -> None:
        self._room: _Room = neighbour._room if neighbour is not None else _Room()
        self._mine: list[_Closer] = []

    def put(self, key: str, payload: bytes, topic: Topic) -> None:
        with self._room.lock:
            sinks = [sink for pattern, sink in self._room.sinks if _matches(pattern, key)]
        now_ns = time.time_ns()
        for sink in sinks:
            sink(key, payload, now_ns)

    def subscribe(self, key: str, sink: Sink, capacity: int) -> Closing:
        return self._enter(self._room.sinks, (key, sink))

    def hold(self, key: str) -> Closing:
        with self._room.lock:
            self._room.tokens.append(key)
            self._tell(key, True)
        return self._closer(lambda: self._release(key))

    def live(self, key: str) -> set[str]:
        with self._room.lock:
            return {token for token in self._room.tokens if _matches(key, token)}

    def watch(self, key: str, watcher: Watcher) -> Closing:
        with self._room.lock:
            for token in sorted(self.live(key)):
                watcher(token, True)
            return self._enter(self._room.watchers, (key, watcher))

    def close(self) -> None:
        for closer in self._mine:
            closer.close()

    def _enter(self, place: list[T], entry: T) -> Closing:
        with self._room.lock:
            place.append(entry)
        return self._closer(lambda: place.remove(entry))

    def _release(self, key: str) -> None:
        with self._room.lock:
            self._room.tokens.remove(key)
            if key not in self._room.tokens:
                self._tell(key, False)

    def _tell(self, key: str, alive: bool) -> None:
        for pattern, watcher in list(self._room.watchers):
            if _matches(pattern, key):
                watcher(key, alive)

    def _closer(self, action: Callable[[], None]) -> Closing:
        closer = _Closer(action)
        self._mine.append(closer)
        return closer


def _matches(pattern: str, key: str) -> bool:
    parts, others = pattern.split("/"), key.split("/")
    return len(parts) == len(others) and all(a in ("*", b) for a, b in zip(parts, others, strict=True))


def wait_for(bus: Bus, address: Address, stages: Iterable[str], timeout_s: float) -> None:
    """Return once each of `stages` is ready on the bus. Raises TransportError that names those which are not."""
    wanted = {address.live(stage): stage for stage in stages}
    changed = threading.Condition()
    alive: set[str] = set()

    def watcher(key: str, is_alive: bool) -> None:
        with changed:
            (alive.add if is_alive else alive.discard)(key)
            changed.notify()

    watching = bus.watch(address.live("*"), watcher)
    try:
        deadline = time.monotonic() + timeout_s
        with changed:
            if changed.wait_for(lambda: wanted.keys() <= alive, deadline - time.monotonic()):
                return
            missing = ", ".join(sorted(stage for key, stage in wanted.items() if key not in alive))
    finally:
        watching.close()
    raise TransportError(f"not ready on the bus after {timeout_s:g} s: {missing}; is each of them running?")
