"""Which processes of a run are hung: they are there, but their main loops say nothing any more.

A heartbeat (`Stats`) leaves a main loop between two messages, so a long call delays it, and so does a core that others
have taken. How long a silence may last is therefore told by what the operating system says of the main thread. One
that is stopped, or has neither run nor been woken for STILL_S, does not work on anything: no process of ours waits for
so long without waking. One that runs may be at a long call, and gets SILENT_S. One that has not been ready yet loads a
field or compiles, and gets START_S unless it is stopped.

Time counts only as far as this process looks: one look counts for a heartbeat at most. Where the whole machine was
suspended, or this process was stopped, nobody else is taken for hung after it.
"""

from __future__ import annotations

import time
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import psutil

from fieldpose.bus.messages import Stats
from fieldpose.bus.node import STATS_PERIOD_S

MISSED = 2
"""So many heartbeats are missing before the operating system is asked at all."""
STILL_S = 6 * STATS_PERIOD_S
SILENT_S = 40 * STATS_PERIOD_S
START_S = 300.0
_ASLEEP = (psutil.STATUS_SLEEPING, psutil.STATUS_DISK_SLEEP, psutil.STATUS_STOPPED, psutil.STATUS_TRACING_STOP)


@dataclass(frozen=True)
class Life:
    """A process as it was seen now.

    heartbeat: a value that changes with each sign of life; None without any so far. ready: it has begun its work.
    loops: its main thread wakes all the time, so that stillness tells something.
    """

    name: str
    pid: int
    heartbeat: Hashable | None
    ready: bool
    loops: bool = True

    @classmethod
    def by_stats(cls, name: str, pid: int, said: Sequence[Stats]) -> Life:
        """Of a stage, by what it said last in each of its pipelines, where its predecessor may still be the last."""
        beats = tuple(stats.header.sent_ns for stats in said)
        return cls(name, pid, beats or None, bool(said) and all(stats.ready for stats in said))


@dataclass(frozen=True)
class Fault:
    """A process that ended without being asked to, or hung and was ended.

    silent_ns: its last sign of life before; back_ns: when its successor was ready, None where it was not; both in ns
    since the epoch.
    """

    process: str
    what: Literal["ended", "hung"]
    silent_ns: int
    back_ns: int | None = None

    @property
    def away_s(self) -> float | None:
        """From the last sign of life to that of its successor at work."""
        return None if self.back_ns is None else (self.back_ns - self.silent_ns) / 1e9


class _Thread(NamedTuple):
    """A main thread: whether it is stopped, whether it sleeps, and how often it was switched to or away."""

    stopped: bool
    asleep: bool
    switches: tuple[int, ...]


@dataclass
class _Watched:
    pid: int
    heartbeat: Hashable | None
    heard_ns: int
    ready: bool = False
    silent_s: float = 0.0
    still_s: float = 0.0
    stopped_s: float = 0.0
    thread: _Thread | None = None
    replaced: bool = False


class Liveness:
    """Told again and again how the processes of a run are; knows who is hung and who came back."""

    def __init__(self) -> None:
        self.faults: list[Fault] = []
        self._watched: dict[str, _Watched] = {}
        self._looked_s: float | None = None

    def look(self, lives: Sequence[Life], now_s: float | None = None) -> list[str]:
        """Take in how the processes are; returns those that are hung, each once.

        now_s: by the monotonic clock.
        """
        now_s = time.monotonic() if now_s is None else now_s
        passed_s = 0.0 if self._looked_s is None else min(max(now_s - self._looked_s, 0.0), STATS_PERIOD_S)
        self._looked_s = now_s
        return [life.name for life in lives if life.pid and self._is_hung(life, passed_s)]

    @property
    def hung(self) -> list[str]:
        """Those that were found to be hung, once for each time."""
        return [fault.process for fault in self.faults if fault.what == "hung"]

    def _is_hung(self, life: Life, passed_s: float) -> bool:
        watched = self._watched.get(life.name)
        if watched is None or watched.pid != life.pid:
            watched = self._watched[life.name] = self._successor(life, watched)
        if life.heartbeat != watched.heartbeat:
            self._heard(life, watched)
            return False
        watched.silent_s += passed_s
        if watched.replaced:
            return False
        if watched.silent_s >= MISSED * STATS_PERIOD_S:
            _look_at_thread(watched, passed_s)
        still_s = max(watched.stopped_s, watched.still_s if watched.ready and life.loops else 0.0)
        if still_s < STILL_S - MISSED * STATS_PERIOD_S and watched.silent_s < (SILENT_S if watched.ready else START_S):
            return False
        watched.replaced = True
        return True

    def _successor(self, life: Life, before: _Watched | None) -> _Watched:
        if before is not None:
            what: Literal["ended", "hung"] = "hung" if before.replaced else "ended"
            self.faults.append(Fault(life.name, what, before.heard_ns))
        return _Watched(life.pid, life.heartbeat, time.time_ns())

    def _heard(self, life: Life, watched: _Watched) -> None:
        watched.heartbeat, watched.heard_ns = life.heartbeat, time.time_ns()
        watched.silent_s = watched.still_s = watched.stopped_s = 0.0
        watched.thread, watched.replaced = None, False
        if life.ready and not watched.ready:
            watched.ready = True
            self._back(life.name, watched.heard_ns)

    def _back(self, name: str, now_ns: int) -> None:
        for i, fault in enumerate(self.faults):
            if fault.process == name and fault.back_ns is None:
                self.faults[i] = replace(fault, back_ns=now_ns)


def _look_at_thread(watched: _Watched, passed_s: float) -> None:
    thread = _thread_of(watched.pid)
    same = thread is not None and thread.asleep and thread == watched.thread
    watched.still_s = watched.still_s + passed_s if same else 0.0
    watched.stopped_s = watched.stopped_s + passed_s if same and thread is not None and thread.stopped else 0.0
    watched.thread = thread


def _thread_of(pid: int) -> _Thread | None:
    """The main thread of a process; None where it is gone, or the system does not tell how often it was switched to."""
    try:
        process = psutil.Process(pid)
        with process.oneshot():
            status, switches = process.status(), tuple(process.num_ctx_switches())
    except (psutil.Error, NotImplementedError):  # the latter where the kernel does not tell switches
        return None
    return _Thread(status == psutil.STATUS_STOPPED, status in _ASLEEP, switches)
