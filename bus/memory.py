"""A bus inside one process, for tests and for running without a hub."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

from fieldpose.bus.protocol import (
    Answer,
    Closer,
    Closing,
    Replies,
    Sink,
    Watcher,
    nobody_answers,
    refusal,
)  # fmt: skip
from fieldpose.bus.topics import Topic, key_matches, keys_meet

T = TypeVar("T")


@dataclass
class _Room:
    """What MemoryBus sessions share; sinks, watchers and answers are called from the thread that puts or asks."""

    lock: threading.RLock = field(default_factory=threading.RLock)
    sinks: list[tuple[str, Sink]] = field(default_factory=list)
    tokens: list[str] = field(default_factory=list)
    watchers: list[tuple[str, Watcher]] = field(default_factory=list)
    served: list[tuple[str, Answer]] = field(default_factory=list)


class MemoryBus:
    """A bus between the threads of one process; a second session joins the first as its neighbour."""

    def __init__(self, neighbour: MemoryBus | None = None) -> None:
        self._room: _Room = neighbour._room if neighbour is not None else _Room()
        self._mine: list[Closer] = []

    def put(self, key: str, payload: bytes, topic: Topic[Any] | None = None) -> None:
        with self._room.lock:
            sinks = [sink for pattern, sink in self._room.sinks if key_matches(pattern, key)]
        now_ns = time.time_ns()
        for sink in sinks:
            sink(key, payload, now_ns)

    def subscribe(self, key: str, sink: Sink, capacity: int) -> Closing:
        return self._enter(self._room.sinks, (key, sink))

    def serve(self, key: str, answer: Answer) -> Closing:
        return self._enter(self._room.served, (key, answer))

    def ask(self, key: str, payload: bytes, timeout_s: float) -> Replies:
        with self._room.lock:
            served = [(name, answer) for name, answer in self._room.served if keys_meet(key, name)]
        answers: dict[str, bytes] = {}
        refusals: list[str] = []
        for name, answer in served:
            try:
                answers[key if "*" in name else name] = answer(payload)
            except Exception as error:
                refusals.append(refusal(name, error))
        if not served:
            raise nobody_answers(key, timeout_s)
        return Replies(answers, tuple(refusals))

    def hold(self, key: str) -> Closing:
        with self._room.lock:
            self._room.tokens.append(key)
            self._tell(key, True)
        return self._closer(lambda: self._release(key))

    def live(self, key: str) -> set[str]:
        with self._room.lock:
            return {token for token in self._room.tokens if key_matches(key, token)}

    def watch(self, key: str, watcher: Watcher) -> Closing:
        with self._room.lock:
            for token in sorted(self.live(key)):
                watcher(token, True)
            return self._enter(self._room.watchers, (key, watcher))

    def settle(self, timeout_s: float, images: bool = False) -> bool:
        return True

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
            if key_matches(pattern, key):
                watcher(key, alive)

    def _closer(self, action: Callable[[], None]) -> Closing:
        closer = Closer(action)
        self._mine.append(closer)
        return closer
