"""How the processes of running pipelines stand, from what they say of themselves: rows to be shown."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from fieldpose.bus.messages import CameraInfo, Message, State, Stats
from fieldpose.bus.ports import Received
from fieldpose.bus.topics import CAMERA_INFO, STATE, STATS, Address
from fieldpose.deploy.graph import BY_NAME

HEARD = (STATS, STATE, CAMERA_INFO)
SILENT_S = 3.0
_WINDOW_NS = 3_000_000_000
_FRAMES_KEPT = 512

Condition = Literal["starting", "ready", "ended", "silent"]


@dataclass(frozen=True)
class Row:
    """A process; rates are over the last seconds, None where it has been heard once only. cpu: 1 is a whole core.

    condition: one that starts, or has said that it ends, is not silent however long it says nothing. heard_s: how long
    ago. restarts: as far as they were seen.
    """

    address: Address
    name: str
    condition: Condition
    heard_s: float
    published_per_s: float | None
    cpu: float | None
    stats: Stats
    restarts: int


@dataclass(frozen=True)
class Heading:
    """A pipeline: tracking's newest state, frames it answers a second, and its latency in ms, None where not known."""

    address: Address
    state: State
    rate_hz: float
    latency_ms: tuple[float, float] | None


@dataclass
class _Process:
    """`heard`: the newest of what a process has said, oldest first, since it started; `was_ready`: in that time."""

    heard: deque[Stats] = field(default_factory=deque)
    received_ns: int = 0
    was_ready: bool = False
    restarts: int = 0

    def note(self, stats: Stats, received_ns: int) -> None:
        if self.heard and _began_again(self.heard[-1], stats):
            self.heard.clear()
            self.restarts += 1
            self.was_ready = False
        self.heard.append(stats)
        self.received_ns = received_ns
        self.was_ready |= stats.ready
        # The first of the window stays as what the newest is compared with.
        while len(self.heard) > 2 and stats.header.sent_ns - self.heard[1].header.sent_ns >= _WINDOW_NS:
            self.heard.popleft()

    def condition(self, heard_s: float) -> Condition:
        if not self.heard[-1].ready:
            return "ended" if self.was_ready else "starting"
        return "silent" if heard_s > SILENT_S else "ready"

    def rates(self) -> tuple[float, float] | None:
        """Messages published and seconds of a core, each a second by the process' own clock."""
        first, last = self.heard[0], self.heard[-1]
        seconds = (last.header.sent_ns - first.header.sent_ns) / 1e9
        if seconds <= 0:
            return None
        return (last.published - first.published) / seconds, (last.cpu_s - first.cpu_s) / seconds


@dataclass
class _Answers:
    """States of the last seconds: when each was received, and its latency where the frame's sending is known."""

    newest: State
    times: deque[tuple[int, float | None]] = field(default_factory=deque)


class Standing:
    """All that was heard of some pipelines on one bus since `began_ns`; times are by `time.time_ns`."""

    def __init__(self, began_ns: int) -> None:
        self._began_ns = began_ns
        self._processes: dict[tuple[Address, str], _Process] = {}
        self._answers: dict[Address, _Answers] = {}
        self._sent: OrderedDict[tuple[str, str, int, int], int] = OrderedDict()

    def note(self, received: Iterable[Received]) -> None:
        """Take in messages of the topics HEARD."""
        for each in received:
            address = each.topic.address_of(each.key)
            if address is not None:
                self._note(address, each.message, each.received_ns)

    def rows(self, now_ns: int) -> list[Row]:
        """Every process that was heard of, pipeline by pipeline, in the order of the graph."""
        order = {name: place for place, name in enumerate(BY_NAME)}
        keys = sorted(
            self._processes, key=lambda key: (key[0].site, key[0].pair, order.get(key[1], len(order)), key[1])
        )
        return [_row(address, name, self._processes[address, name], now_ns) for address, name in keys]

    def headings(self, now_ns: int) -> list[Heading]:
        """Every pipeline whose tracking was heard of."""
        known = sorted(self._answers.items(), key=lambda item: (item[0].site, item[0].pair))
        window_ns = min(_WINDOW_NS, now_ns - self._began_ns)
        return [_heading(address, answers, now_ns, window_ns) for address, answers in known]

    def _note(self, address: Address, message: Message, received_ns: int) -> None:
        match message:
            case Stats():
                self._processes.setdefault((address, message.stage), _Process()).note(message, received_ns)
            case CameraInfo():
                self._sent[address.site, address.camera, *message.header.frame_key] = message.header.sent_ns
                if len(self._sent) > _FRAMES_KEPT:
                    self._sent.popitem(last=False)
            case State():
                sent_ns = self._sent.get((address.site, address.camera, *message.header.frame_key))
                latency_ms = None if sent_ns is None else (message.header.sent_ns - sent_ns) / 1e6
                answers = self._answers.setdefault(address, _Answers(message))
                answers.newest = message
                answers.times.append((received_ns, latency_ms))
                _forget(answers, received_ns)


def _began_again(before: Stats, stats: Stats) -> bool:
    """A process numbers its messages from 0 when it starts."""
    return stats.header.sequence <= before.header.sequence


def _row(address: Address, name: str, process: _Process, now_ns: int) -> Row:
    heard_s = max(0.0, (now_ns - process.received_ns) / 1e9)
    published, cpu = process.rates() or (None, None)
    condition = process.condition(heard_s)
    if condition != "ready":
        published = cpu = None
    return Row(address, name, condition, heard_s, published, cpu, process.heard[-1], process.restarts)


def _heading(address: Address, answers: _Answers, now_ns: int, window_ns: int) -> Heading:
    _forget(answers, now_ns)
    known = [latency_ms for _, latency_ms in answers.times if latency_ms is not None]
    latency_ms = (float(np.percentile(known, 50)), float(np.percentile(known, 90))) if known else None
    return Heading(address, answers.newest, len(answers.times) / (window_ns / 1e9), latency_ms)


def _forget(answers: _Answers, now_ns: int) -> None:
    while answers.times and answers.times[0][0] < now_ns - _WINDOW_NS:
        answers.times.popleft()
