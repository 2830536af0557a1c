"""Whole pipelines on this machine: their processes started, watched and ended, their results gathered."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from fieldpose.bus.messages import State
from fieldpose.bus.parts_info import joined
from fieldpose.bus.reading import RecordingInfo, info
from fieldpose.bus.segments import removed_orphans
from fieldpose.bus.signals import StopSignals
from fieldpose.bus.topics import Address, shared_address
from fieldpose.bus.transport import ZenohBus
from fieldpose.deploy.access.joining import Entry, Joint, access_as, hub_keys
from fieldpose.deploy.graph import CAMERA, HUB, OBSERVER, RECORDER, STAGES
from fieldpose.deploy.plan import Plan
from fieldpose.deploy.processes.collector import Collector
from fieldpose.deploy.processes.endpoints import check_free, free_port
from fieldpose.deploy.processes.liveness import Life, Liveness
from fieldpose.deploy.processes.programs import Member, members, preloading, programs
from fieldpose.deploy.processes.supervision import Supervisor
from fieldpose.deploy.recording_options import RecordingOptions, recorded_files, unfinished_files
from fieldpose.deploy.reporting.results import RunResult
from fieldpose.errors import OutputError, ProcessError

_START_S = 300.0
_RESTARTS_AT_START, _RESTARTS = 2, 10
_POLL_S = 0.1
_SETTLE_S = 0.2
_STAGES_STOP_S, _HUB_STOP_S = 2.0, 0.5
_RECORDER_FINISHES_S, _RECORDER_HURRIES_S = 60.0, 2.0
"""It has up to 512 MB to write, on a disk that may be slow; a second Ctrl-C cuts it short, but one that follows at once
has not to cost the recording."""


@dataclass(frozen=True)
class Run:
    """Plans on this machine, of one pipeline each, with one hub and one recorder.

    listen: the hub's address (default: a free port); logs: a folder to keep; recording: how it is recorded; entry: who
    is let in; order: names of processes to be started first, in this order, before the others in that of the graph.
    """

    plans: tuple[Plan, ...]
    record: Path | None = None
    listen: str | None = None
    logs: Path | None = None
    recording: RecordingOptions = field(default_factory=RecordingOptions)
    entry: Entry = field(default_factory=Entry)
    order: tuple[str, ...] = ()

    @property
    def recorded(self) -> bool:
        """Whether there is a recorder, be it for snapshots alone."""
        return self.record is not None or self.recording.snapshots is not None


@dataclass(frozen=True)
class Standing:
    """How far a pipeline is: frames sent, how many a second tracking reports on, and its newest state."""

    address: Address
    sent: int = 0
    rate_hz: float = 0.0
    state: State | None = None


@dataclass(frozen=True)
class Progress:
    """What a run is doing, for people to look at.

    standings: of each pipeline; pids: its processes by name; hub: where others can join it; hung: those that were
    found to be hung and were replaced, once for each time.
    """

    phase: Literal["starting", "running", "finishing"]
    waiting_for: tuple[str, ...] = ()
    standings: tuple[Standing, ...] = ()
    restarts: int = 0
    hung: tuple[str, ...] = ()
    pids: Mapping[str, int] = field(default_factory=dict)
    hub: str = ""


Report = Callable[[Progress], None]


def run_pipeline(plan: Plan, report: Report = lambda progress: None, record: Path | None = None) -> RunResult:
    """Run a single pipeline, as `run_pipelines` does."""
    (result,) = run_pipelines(Run((plan,), record), report)
    return result


def run_pipelines(run: Run, report: Report = lambda progress: None) -> list[RunResult]:
    """Run the sources to their ends, or until Ctrl-C or SIGTERM, and end every process; gives a result for each plan.

    Raises ProcessError where a process cannot start or does not stay up, TransportError for a bad or used address or
    certificates that are missing, UsageError for an address that other hosts reach and nobody is kept out of,
    RecordingError for a recording that is in the way. One that could not be finished is told of in the results: for
    want of a disk nothing stops tracking.
    """
    fields = {plan.field for plan in run.plans if plan.field is not None}
    run.recording.check(run.record, len(run.plans), sum(field.stat().st_size for field in fields))
    check_free(run.listen)
    with (
        StopSignals() as signals,
        _folder(run.logs) as folder,
        hub_keys(run.listen or f"tcp/127.0.0.1:{free_port()}", run.entry) as (hub, keys),
    ):
        at = Joint(hub, None if keys is None else access_as(keys, OBSERVER))
        made = programs(run.plans, folder, hub, run.record, run.recording, keys)
        made.sort(key=lambda program: run.order.index(program.name) if program.name in run.order else len(run.order))
        with removed_orphans(), Supervisor(folder, made, preloading(folder), run.logs is None) as supervisor:
            return _Running(run, supervisor, at, signals, report).run()


class _Running:
    def __init__(self, run: Run, supervisor: Supervisor, at: Joint, signals: StopSignals, report: Report) -> None:
        self._of, self._plans = run, run.plans
        self._members = members(run.plans, run.recorded)
        self._cameras = [member.name for member in self._members if member.row.name == CAMERA]
        self._collectors: list[Collector] = []
        self._supervisor = supervisor
        self._liveness = Liveness()
        self._hub_looks = 0
        self._at = at
        self._stop, self._again = signals.stop, signals.again
        self._report = report
        self._limit = _RESTARTS_AT_START
        self._spared: tuple[str, ...] = ()
        self._pids: dict[str, int] = {}

    def run(self) -> list[RunResult]:
        began = time.monotonic()
        self._bus = bus = self._at.session()
        try:
            self._collectors = [
                Collector(bus, plan.settings.address, plan.object_from_dataset()) for plan in self._plans
            ]
            token = bus.hold(self._plans[0].settings.address.live(OBSERVER))
            start_s = self._start(bus) - began
            # Where other programs send the frames, it is Ctrl-C that ends the source.
            finished = self._watch() or not self._cameras
            self._finish()
            token.close()
            for collector in self._collectors:
                collector.close()
        finally:
            bus.close()
        recording, recording_error = recorded_by(self._of, self._supervisor)
        return [
            replace(self._result(plan, collector, recording, finished, start_s), recording_error=recording_error)
            for plan, collector in zip(self._plans, self._collectors, strict=True)
        ]

    def _result(
        self, plan: Plan, collector: Collector, recording: RecordingInfo | None, finished: bool, start_s: float
    ) -> RunResult:  # fmt: skip
        its = [member for member in self._members if plan in member.plans]
        restarts = self._supervisor.restarts
        return RunResult(
            frames=collector.results(),
            sent=collector.sent,
            stats=collector.stats,
            observed=collector.observed,
            forgotten=collector.forgotten,
            restarts={member.row.name: restarts[member.name] for member in its if member.name in restarts},
            plan=plan.notes,
            recording=None if recording is None else recording.of(plan.settings.address),
            faults=[
                replace(fault, process=member.row.name)
                for fault in self._liveness.faults
                for member in its
                if member.name == fault.process
            ],
            interrupted=not finished,
            start_s=start_s,
        )

    def _start(self, bus: ZenohBus) -> float:
        """Return when all processes are ready, or are to be stopped; returns when that was."""
        those = [member for member in self._members if member.row.name != HUB]
        wanted = {at.live(member.row.name): member.name for member in those for at in member.at}
        alive: set[str] = set()
        everywhere = shared_address([plan.settings.address for plan in self._plans]).live("*")
        watching = bus.watch(everywhere, lambda key, up: (alive.add if up else alive.discard)(key))
        deadline = time.monotonic() + _START_S
        while not self._stop.is_set():
            waiting = tuple(dict.fromkeys(name for key, name in wanted.items() if key not in alive))
            cameras_finished = self._look()
            if not waiting or cameras_finished or any(collector.sent for collector in self._collectors):
                break
            if time.monotonic() > deadline:
                raise ProcessError(f"not ready after {_START_S:g} s: {', '.join(waiting)}")
            self._report(Progress("starting", waiting, hub=self._at.hub))
            self._stop.wait(_POLL_S)
        watching.close()
        self._limit = _RESTARTS
        # From here on the end of a recording is no reason to stop tracking.
        self._spared = (RECORDER,)
        return time.monotonic()

    def _watch(self) -> bool:
        """Look after the processes until all cameras have finished; False where they were stopped before."""
        while not self._stop.is_set():
            if self._look():
                return True
            self._report(self._progress("running"))
            self._stop.wait(_POLL_S)
        return False

    def _look(self) -> bool:
        """Take in what has come and check on the processes; returns whether all cameras have finished."""
        for collector in self._collectors:
            collector.update()
        processes = self._supervisor.check(self._limit, self._spared)
        self._pids = {name: process.pid for name, process in processes.items() if process.pid}
        for name in self._liveness.look([self._life(member) for member in self._members]):
            self._supervisor.kill(name)
        ended = [name in processes and processes[name].finished for name in self._cameras]
        return bool(ended) and all(ended)

    def _life(self, member: Member) -> Life:
        """How a process is, by what has come of it."""
        pid = self._pids.get(member.name, 0)
        if member.row.name == HUB:
            linked = self._bus.has_hub
            self._hub_looks += linked
            return Life(member.name, pid, self._hub_looks, linked, loops=False)
        said = [
            stats
            for plan, collector in zip(self._plans, self._collectors, strict=True)
            if plan in member.plans and (stats := collector.stats.get(member.row.name)) is not None
        ]
        return Life.by_stats(member.name, pid, said)

    def _finish(self) -> None:
        """End the stages, then the recorder, so that it has all that they said, then the hub."""
        self._report(self._progress("finishing"))
        time.sleep(_SETTLE_S)
        self._supervisor.stop([member.name for member in self._members if member.row.name in STAGES], _STAGES_STOP_S)
        time.sleep(_SETTLE_S)
        for collector in self._collectors:
            collector.update()
        began = time.monotonic()
        self._supervisor.stop(
            [RECORDER],
            _RECORDER_FINISHES_S,
            lambda: self._again.is_set() and time.monotonic() - began >= _RECORDER_HURRIES_S,
        )
        self._supervisor.stop([HUB], _HUB_STOP_S)

    def _progress(self, phase: Literal["running", "finishing"]) -> Progress:
        now_ns = time.time_ns()
        standings = (
            Standing(plan.settings.address, collector.sent, collector.rate_hz(now_ns), collector.newest_state)
            for plan, collector in zip(self._plans, self._collectors, strict=True)
        )
        restarts = sum(self._supervisor.restarts.values())
        return Progress(
            phase, standings=tuple(standings), restarts=restarts, hung=tuple(self._liveness.hung), pids=self._pids
        )


def recorded_by(run: Run, supervisor: Supervisor) -> tuple[RecordingInfo | None, str | None]:
    """What a run's recorder has written in fieldpose's own messages, and what it could not write, in a line."""
    if not supervisor.has_run(RECORDER):
        return None, None
    failure = supervisor.failure(RECORDER)
    if run.record is None:
        return None, failure
    split = run.recording.split is not None
    error = failure
    if any(unfinished_files(path, split) for path in run.recording.files(run.record)):
        error = f"{run.record}: the recording was not finished: {supervisor.last_line(RECORDER)}"
    native = () if run.recording.format == "foxglove" else recorded_files(run.record, split)
    held = joined([info(path) for path in native])
    if error is None and held is not None and held.ended is not None:
        error = f"{held.path}: the recording ended early: {held.ended}; what came before is in it"
    return held, error


@contextmanager
def _folder(kept: Path | None) -> Iterator[Path]:
    """A folder for what the processes need and say; one that was not asked for is kept only if they fail."""
    if kept is not None:
        try:
            kept.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{kept}: no folder for logs can be made there: {error.strerror}") from error
        if not os.access(kept, os.W_OK):
            raise OutputError(f"{kept}: no right to write logs there")
        yield kept.resolve()
        return
    folder = Path(tempfile.mkdtemp(prefix="fieldpose-"))
    try:
        yield folder
    except ProcessError as error:
        if str(folder) not in str(error):
            shutil.rmtree(folder, ignore_errors=True)
        raise
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    shutil.rmtree(folder, ignore_errors=True)
