"""Makes things go wrong in a run that is under way, one after another, each once all is well again."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import psutil

from fieldpose.bus.messages import TrackingState
from fieldpose.bus.segments import segments_of
from fieldpose.deploy.benchmarks.chaos.events import PAUSE_S, SUPERVISOR, Event, Kind
from fieldpose.deploy.processes.pipeline import Progress

_WELL_S = 1.0
SETTLED_S = 2.5
"""After the cause is gone, until the next one: longer than tracking may take."""
_PATIENCE_S = 30.0
"""It goes on all the same after so long."""


@dataclass
class Done:
    """An event that was brought about; gone_ns: when its cause was gone, by itself or by the supervisor's doing."""

    event: Event
    at_ns: int
    pid: int
    gone_ns: int | None = None


class Injector:
    """Looks at a run's progress; ends the run, as a Ctrl-C would, once all events are done.

    settled_s: from when a cause is gone until the next event at the soonest. segments, folder: what the processes of
    the run have used of shared memory, and where they kept their files.
    """

    def __init__(self, events: Sequence[Event], settled_s: float = SETTLED_S) -> None:
        self.done: list[Done] = []
        self.segments: set[Path] = set()
        self.folder: Path | None = None
        self.stopped = False
        self._left, self._settled_s = list(events), settled_s
        self._well_since: float | None = None
        self._gone_at = self._began = time.monotonic()
        self._hung_before = 0

    def __call__(self, progress: Progress) -> None:
        if progress.phase == "starting":
            self._began = self._gone_at = time.monotonic()
        if progress.phase != "running":
            return
        now = time.monotonic()
        self._note_well(progress, now)
        if self.done and self.done[-1].gone_ns is None:
            self._look_whether_gone(self.done[-1], progress, now)
        elif self._left and self._ready(now):
            self._look_around(progress)
            self._bring_about(self._left.pop(0), progress)
        elif not self._left and self._is_over(progress, now) and not self.stopped:
            self._look_around(progress)
            self.stopped = True
            signal.raise_signal(signal.SIGINT)

    @property
    def not_done(self) -> list[Event]:
        """Events for which the source was too short."""
        return list(self._left)

    def _note_well(self, progress: Progress, now: float) -> None:
        state = progress.standings[0].state
        late = state is None or time.time_ns() - state.header.sent_ns > 0.5e9
        if late or state is None or state.state is not TrackingState.TRACKING:
            self._well_since = None
        elif self._well_since is None:
            self._well_since = now

    def _ready(self, now: float) -> bool:
        if now - self._gone_at > _PATIENCE_S:
            return True
        settled = not self.done or now - self._gone_at > self._settled_s
        wait_s = self._left[0].wait_s + (_WELL_S if self.done else 0.0)
        return settled and self._well_since is not None and now - self._well_since > wait_s

    def _is_over(self, progress: Progress, now: float) -> bool:
        """Whether the last event has been settled, and who was hit has a successor, by which a fault is noticed."""
        if now - self._gone_at <= self._settled_s:
            return False
        last = self.done[-1] if self.done else None
        if last is None or last.event.kind is Kind.PAUSE or last.event.process == SUPERVISOR:
            return True
        replaced = progress.pids.get(last.event.process, last.pid) != last.pid
        return replaced or now - self._gone_at > _PATIENCE_S

    def _bring_about(self, event: Event, progress: Progress) -> None:
        pid = _supervisor() if event.process == SUPERVISOR else progress.pids.get(event.process, 0)
        if not pid:
            self._left.insert(0, event)  # it is away still
            return
        number = signal.SIGKILL if event.kind is Kind.KILL else signal.SIGSTOP
        self.done.append(Done(event, time.time_ns(), pid))
        self._hung_before = len(progress.hung)
        os.kill(pid, number)
        if event.kind is Kind.KILL:
            self._gone(self.done[-1])

    def _look_whether_gone(self, done: Done, progress: Progress, now: float) -> None:
        if len(progress.hung) > self._hung_before or not psutil.pid_exists(done.pid):
            self._gone(done)
        elif done.event.kind is Kind.PAUSE and time.time_ns() - done.at_ns > PAUSE_S * 1e9:
            with suppress(ProcessLookupError):
                os.kill(done.pid, signal.SIGCONT)
            self._gone(done)

    def _gone(self, done: Done) -> None:
        done.gone_ns, self._gone_at = time.time_ns(), time.monotonic()
        self._well_since = None

    def _look_around(self, progress: Progress) -> None:
        self.segments |= segments_of(progress.pids.values())
        supervisor = psutil.Process(_supervisor())
        command = " ".join(supervisor.cmdline()).split()
        self.folder = Path(command[command.index("-c") + 1]).parent


def _supervisor() -> int:
    for process in psutil.Process().children():
        if SUPERVISOR in " ".join(process.cmdline()):
            return int(process.pid)
    raise RuntimeError("no supervisord below this process")
