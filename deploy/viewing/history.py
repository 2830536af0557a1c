"""How a pipeline has done second by second: rates, latencies, how long each stage took, what was dropped or missed."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from cachetools import FIFOCache

from fieldpose.bus.messages import Header, Message, State, Stats
from fieldpose.bus.topics import (
    CAMERA_INFO,
    CORRESPONDENCES,
    ESTIMATE,
    FAILURE,
    FRAME,
    GUESS,
    MATCHES,
    POSE,
    RETRIEVED,
    SEARCH,
    STATE,
    STATS,
    VIEW,
    Topic,
)

BY_HEADER: tuple[Topic[Any], ...] = (
    FRAME, CAMERA_INFO, SEARCH, RETRIEVED, GUESS, VIEW, MATCHES, CORRESPONDENCES, ESTIMATE, POSE, FAILURE,
)  # fmt: skip
"""Of these a header is enough: when something was sent, and by whom."""
IN_FULL: tuple[Topic[Any], ...] = (STATE, STATS)
_NS = 1_000_000_000
_UNDER_WAY = 256
"""Frames, and passes over frames, of which it is remembered when their messages were sent."""


@dataclass
class _Second:
    """What was said in a second: how much of each, and milliseconds."""

    counts: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    scores: list[float] = field(default_factory=list)
    latency_ms: list[float] = field(default_factory=list)
    stage_ms: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))


@dataclass(frozen=True)
class Curves:
    """Lines of one plot: seconds (n,), and by name of the line (n,) float64 without NaN."""

    seconds: np.ndarray
    lines: dict[str, np.ndarray]


class History:
    """Figures of the newest `kept` seconds, by when messages were received on one host.

    Durations are between sendings: where these are of several hosts, they are as good as their clocks agree.
    """

    def __init__(self, kept: int) -> None:
        self._kept = kept
        self._seconds: dict[int, _Second] = {}
        self._began_ns: int | None = None
        self._newest = 0
        self._frames: FIFOCache[tuple[int, int], int] = FIFOCache(_UNDER_WAY)
        self._passes: FIFOCache[tuple[int, int, int], list[tuple[int, str]]] = FIFOCache(_UNDER_WAY)
        self._door: State | None = None
        self._gaps: dict[str, int] = {}

    @property
    def now(self) -> float:
        """The newest second of which anything is known, from the first."""
        return float(self._newest)

    def note_header(self, topic: Topic[Any], header: Header, received_ns: int) -> None:
        """Take in that a message of BY_HEADER was sent."""
        second = self._at(received_ns)
        if topic in (FRAME, CAMERA_INFO):
            if header.frame_key not in self._frames:
                self._frames[header.frame_key] = header.sent_ns
                second.counts["frames"] += 1
            return
        sent = self._passes.setdefault((*header.frame_key, header.pass_index), [])
        sent.append((header.sent_ns, header.source))
        if topic in (POSE, FAILURE):
            second.counts["solves"] += topic is POSE
            # On a busy host they are not received in the order in which they were sent.
            for (before, _), (now, source) in pairwise(sorted(sent)):
                second.stage_ms[source].append((now - before) / 1e6)
            sent.clear()

    def note(self, message: Message, received_ns: int) -> None:
        """Take in a message of IN_FULL."""
        second = self._at(received_ns)
        match message:
            case State():
                self._note_state(message, second)
            case Stats():
                before, self._gaps[message.stage] = self._gaps.get(message.stage), message.gaps
                if before is not None:
                    second.counts["gaps"] += max(0, message.gaps - before)

    def rates(self) -> Curves:
        """Frames of the camera, poses that were measured, and solves that found one, each a second."""
        names = {"camera frames": "frames", "poses": "poses", "solves": "solves"}
        return self._curves({line: [second.counts[n] for second in self._whole()] for line, n in names.items()})

    def losses(self) -> Curves:
        """Frames dropped at the door and lost on their way, and messages that did not come, each a second."""
        names = {"dropped at the door": "dropped", "lost on their way": "lost", "missing messages": "gaps"}
        return self._curves({line: [second.counts[n] for second in self._whole()] for line, n in names.items()})

    def scores(self) -> Curves:
        """The typical score of a second, and its lowest."""
        kept = [np.array(second.scores) for second in self._whole()]
        return self._curves({"typical": [_typical(k) for k in kept], "lowest": [k.min(initial=np.inf) for k in kept]})

    def latencies(self) -> Curves:
        """Milliseconds from the sending of a frame to that of its state: typical of a second, and its longest."""
        kept = [np.array(second.latency_ms) for second in self._whole()]
        return self._curves({"typical": [_typical(k) for k in kept], "longest": [k.max(initial=-np.inf) for k in kept]})

    def stages(self, order: tuple[str, ...]) -> Curves:
        """Milliseconds that each stage took for a pass over a frame, of the seconds in which anything was solved.

        From what was sent before it to its own sending, so with all waiting; 0 where it had nothing to do.
        """
        seconds = self._whole()
        stages = [stage for stage in order if any(stage in second.stage_ms for second in seconds)]
        lines = {
            stage: [_typical(np.array(s.stage_ms.get(stage, [0.0]))) if s.stage_ms else np.nan for s in seconds]
            for stage in stages
        }
        return self._curves(lines)

    def _note_state(self, state: State, second: _Second) -> None:
        before = self._door
        second.scores.append(state.score)
        second.counts["poses"] += state.score > 0
        sent_ns = self._frames.get(state.header.frame_key)
        if sent_ns is not None:
            second.latency_ms.append((state.header.sent_ns - sent_ns) / 1e6)
        if before is not None:
            # Tracking that was started again counts from 0.
            second.counts["dropped"] += max(0, state.dropped_at_the_door - before.dropped_at_the_door)
            second.counts["lost"] += max(0, state.lost - before.lost)
        self._door = state

    def _at(self, received_ns: int) -> _Second:
        if self._began_ns is None:
            self._began_ns = received_ns
        number = (received_ns - self._began_ns) // _NS
        if number > self._newest:
            self._newest = number
            for old in [old for old in self._seconds if old <= number - self._kept]:
                del self._seconds[old]
        return self._seconds.setdefault(number, _Second())

    def _numbers(self) -> range:
        """The seconds that are over and not too old, those in which nothing was said among them."""
        return range(max(0, self._newest - self._kept + 1), self._newest)

    def _whole(self) -> list[_Second]:
        return [self._seconds.get(number) or _Second() for number in self._numbers()]

    def _curves(self, lines: dict[str, list[float]]) -> Curves:
        """Without the seconds of which a line knows nothing."""
        seconds, values = np.array(self._numbers(), np.float64), {n: np.array(v, np.float64) for n, v in lines.items()}
        known = np.isfinite(np.array(list(values.values())).reshape(len(values), len(seconds))).all(axis=0)
        return Curves(seconds[known], {name: line[known] for name, line in values.items()})


def _typical(values: np.ndarray) -> float:
    return float(np.median(values)) if len(values) else np.nan
