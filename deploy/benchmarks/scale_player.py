"""A process of the graph whose work is replaced by what it has once said.

It listens to what that listens to, decodes what comes, and sends what was recorded at the times of then, for each of
several cameras.
"""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np

from fieldpose.bus.handlers import EndOfInput, Output
from fieldpose.bus.messages import Message
from fieldpose.bus.node import run_nodes
from fieldpose.bus.reading import read_recording
from fieldpose.bus.topics import Address, Topic
from fieldpose.bus.transport import LOCAL_HUB, ZenohBus
from fieldpose.deploy.graph import BY_NAME, OBSERVER
from fieldpose.deploy.processes.lifeline import die_with_parent

_AFTER_S, _NOTHING_S, _SOON_S = 1.0, 0.02, 0.0005


class Part(msgspec.Struct, frozen=True):
    """What a process is to be: of which row, for which cameras, and how long; home: where who started it is."""

    process: str
    recording: str
    cameras: tuple[str, ...]
    seconds: float
    home: str
    hub: str = LOCAL_HUB


class Told(msgspec.Struct, frozen=True):
    """What came to it: how old in ms, and how far it was behind with sending, in ms."""

    age_ms: tuple[float, float, float]
    behind_ms: float


class Line(NamedTuple):
    """What is sent, and how long after the beginning."""

    after_s: float
    topic: Topic[Any]
    message: Message


class Player:
    """Sends the recorded messages of a row once `begun`; offset_s: so much later, as cameras are not in step."""

    def __init__(
        self, process: str, script: Sequence[Line], seconds: float, offset_s: float, begun: Callable[[], bool]
    ) -> None:
        row = BY_NAME[process]
        self.name, self.inputs, self.outputs = process, row.reads, row.writes
        self.age_ms: list[float] = []
        self.behind_ms = 0.0
        self._script, self._seconds, self._offset_s, self._begun = script, seconds, offset_s, begun
        self._began = 0.0
        self._next = 0

    def start(self) -> None:
        """Nothing to load."""

    def stop(self) -> None:
        """Nothing to let go."""

    def handle(self, topic: Topic[Any], message: Message) -> Iterator[Output]:
        self.age_ms.append((time.time_ns() - message.header.sent_ns) / 1e6)
        return iter(())

    def tick(self, now_ns: int) -> Iterator[Output]:
        if not self._began:
            if not self._begun():
                return
            self._began = time.monotonic() + self._offset_s
        at = time.monotonic() - self._began
        while self._next < len(self._script) and self._script[self._next].after_s <= at:
            line = self._script[self._next]
            self.behind_ms = max(self.behind_ms, 1e3 * (at - line.after_s))
            self._next += 1
            yield line.topic, line.message
        if at > self._seconds + _AFTER_S:
            raise EndOfInput

    def tick_in_s(self, now_ns: int) -> float:
        if not self._began or self._next >= len(self._script):
            return _NOTHING_S
        return max(_SOON_S, self._script[self._next].after_s - (time.monotonic() - self._began))


def scripted(recording: str, process: str, seconds: float) -> list[Line]:
    """What a process said in the first seconds of a recording."""
    began: int | None = None
    script = []
    for recorded in read_recording(recording):
        began = recorded.log_time_ns if began is None else began
        after_s = (recorded.log_time_ns - began) / 1e9
        its = recorded.topic in BY_NAME[process].writes and recorded.message.header.source == process
        if its and after_s < seconds:
            script.append(Line(after_s, recorded.topic, recorded.message))
    return script


def play(text: str) -> None:
    """Be what `text`, a Part as JSON, says; prints what came, as JSON."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    die_with_parent()
    part = msgspec.json.decode(text, type=Part)
    script = scripted(part.recording, part.process, part.seconds)
    bus = ZenohBus(part.hub)
    at_home = Address(camera=part.home).live(OBSERVER)
    offsets = [number / 30.0 / len(part.cameras) for number in range(len(part.cameras))]

    def begun() -> bool:
        return bool(bus.live(at_home))

    players = [Player(part.process, script, part.seconds, offset_s, begun) for offset_s in offsets]
    try:
        run_nodes([(one, Address(camera=camera)) for one, camera in zip(players, part.cameras, strict=True)], bus)
    finally:
        bus.close()
    ages = np.array([age for player in players for age in player.age_ms] or [0.0])
    p50, p99 = np.percentile(ages, (50, 99))
    told = Told((float(p50), float(p99), float(ages.max())), max(player.behind_ms for player in players))
    sys.stdout.buffer.write(msgspec.json.encode(told))
