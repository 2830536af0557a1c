"""A long live run: whether memory grows, latencies drift, frames are lost or poses go wrong over time."""

from __future__ import annotations

import signal
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import cycle
from typing import Any

import numpy as np
import psutil

from fieldpose.bus.messages import State
from fieldpose.connection import Connection, connect
from fieldpose.deploy.benchmarks import machine
from fieldpose.deploy.benchmarks.sequences import Sequence as Followed
from fieldpose.deploy.benchmarks.sequences import there_and_back
from fieldpose.deploy.commands.run import planned
from fieldpose.deploy.processes.pipeline import Progress, Run, run_pipelines
from fieldpose.deploy.settings import Settings, changed
from fieldpose.errors import TransportError
from fieldpose.stages.camera.core import CapturedFrame

_JOIN_S, _LOOK_S, _MINUTE_S = 30.0, 2.0, 60.0
_NS = 1e9
Report = Callable[[str], None]


@dataclass
class Minute:
    """What was seen in one: frames sent, states, those tracking was sure of, milliseconds, memory by process."""

    sent: int = 0
    states: int = 0
    sure: int = 0
    wrong: int = 0
    latency_ms: list[float] = field(default_factory=list)
    rss_mb: defaultdict[str, list[float]] = field(default_factory=lambda: defaultdict(list))


def measure(followed: Followed, seconds: float, rate_hz: float, report: Report) -> dict[str, Any]:
    """Everything that `fieldpose bench endure` prints, as its JSON. Raises what a run raises."""
    settings = changed(Settings(), {"camera": {"source": "bus"}, "tracking": {"sequence": "video"}}, "bench endure")
    watch = _Watch(there_and_back(followed.recording), followed, seconds, rate_hz, report)
    (outcome,) = run_pipelines(Run((planned(settings, followed.field),)), watch)
    watch.join()
    minutes = [_figures(minute) for minute in watch.minutes]
    return {
        "machine": machine.describe(), "seconds": seconds, "rate_hz": rate_hz, "minutes": minutes,
        "growth": growth(minutes), "restarts": sum(outcome.restarts.values()),
        "sent": sum(minute.sent for minute in watch.minutes), "wrong": sum(minute.wrong for minute in watch.minutes),
    }  # fmt: skip


def growth(minutes: Sequence[dict[str, Any]]) -> dict[str, float] | None:
    """By process and of all together, by which share memory is larger in the last whole minute than in the second.

    The first is left out, for then everything is loaded and cached. None for runs of less than three minutes.
    """
    looked_at = [minute["rss_mb"] for minute in minutes if minute["rss_mb"]]
    if len(looked_at) < 3:
        return None
    first, last = looked_at[1], looked_at[-1]
    grown = {name: last[name] / first[name] - 1 for name in first if name in last}
    return {**grown, "all": sum(last.values()) / sum(first.values()) - 1}


class _Watch:
    """Looks at a run's progress; once it runs, shows it the film, listens, and ends it when the time is over."""

    def __init__(
        self, shots: Sequence[CapturedFrame], followed: Followed, seconds: float, rate_hz: float, report: Report
    ) -> None:  # fmt: skip
        self.minutes: list[Minute] = []
        self._shots, self._limit, self._seconds, self._rate_hz, self._report = (
            shots, followed.limit, seconds, rate_hz, report,
        )  # fmt: skip
        self._hub = ""
        self._began_ns = 0
        self._looked = 0.0
        self._over = threading.Event()
        self._threads: list[threading.Thread] = []
        self._error: Exception | None = None

    def __call__(self, progress: Progress) -> None:
        self._hub = progress.hub or self._hub
        if progress.phase != "running" or self._over.is_set():
            return
        if not self._threads:
            self._began_ns = time.time_ns()
            self._threads = [threading.Thread(target=self._take_part, args=(self._hub,), name="film")]
            self._threads[0].start()
        now = time.monotonic()
        if now - self._looked > _LOOK_S:
            self._looked = now
            minute = self._minute(time.time_ns())
            for name, pid in progress.pids.items():
                if psutil.pid_exists(pid):
                    minute.rss_mb[name].append(psutil.Process(pid).memory_info().rss / 2**20)
            self._report(f"{(time.time_ns() - self._began_ns) / _NS:.0f} of {self._seconds:.0f} s")
        if time.time_ns() - self._began_ns > self._seconds * _NS or self._error is not None:
            self._over.set()
            signal.raise_signal(signal.SIGINT)

    def join(self) -> None:
        """Wait for what was begun. Raises what went wrong in it."""
        self._over.set()
        for thread in self._threads:
            thread.join()
        if self._error is not None:
            raise self._error

    def _take_part(self, hub: str) -> None:
        try:
            with connect(hub, timeout_s=_JOIN_S) as pipeline:
                listening = threading.Thread(target=self._listen, args=(pipeline,), name="listen")
                listening.start()
                try:
                    self._show(pipeline)
                finally:
                    self._over.set()
                    listening.join()
        except TransportError as error:
            self._error = error

    def _show(self, pipeline: Connection) -> None:
        began = time.monotonic()
        for number, shot in enumerate(cycle(self._shots)):
            if self._over.wait(max(0.0, began + number / self._rate_hz - time.monotonic())):
                return
            now_ns = time.time_ns()
            pipeline.publish(shot.image, shot.camera, now_ns, shot.encoding, number)
            self._minute(now_ns).sent += 1

    def _listen(self, pipeline: Connection) -> None:
        while not self._over.is_set():
            for state in pipeline.states(timeout_s=0.5):
                self._note(state)
                if self._over.is_set():
                    break

    def _note(self, state: State) -> None:
        header = state.header
        minute = self._minute(header.capture_ns)
        minute.states += 1
        minute.latency_ms.append((header.sent_ns - header.capture_ns) * 1e-6)
        if not state.is_sure or state.cam_from_object is None:
            return
        minute.sure += 1
        truth = self._shots[header.frame_id % len(self._shots)].truth
        if truth is not None and truth.cam_from_object is not None:
            minute.wrong += not self._limit.holds(truth.cam_from_object, state.cam_from_object)

    def _minute(self, at_ns: int) -> Minute:
        number = max(0, int((at_ns - self._began_ns) / _NS / _MINUTE_S))
        while len(self.minutes) <= number:
            self.minutes.append(Minute())
        return self.minutes[number]


def _figures(minute: Minute) -> dict[str, Any]:
    spread = np.percentile(minute.latency_ms, (50, 99)).tolist() if minute.latency_ms else None
    return {
        "sent": minute.sent, "states": minute.states, "sure": minute.sure, "wrong": minute.wrong,
        "latency_ms": None if spread is None else dict(zip(("p50", "p99"), spread, strict=True)),
        "rss_mb": {name: float(np.median(sizes)) for name, sizes in sorted(minute.rss_mb.items())},
    }  # fmt: skip
