"""A whole pipeline on this machine: its processes started, watched and ended, its results gathered."""

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
from fieldpose.bus.recording import partial_path
from fieldpose.bus.replay import RecordingInfo, info
from fieldpose.bus.signals import StopSignals
from fieldpose.bus.transport import ZenohBus
from fieldpose.deploy.graph import (
    BY_NAME,
    CAMERA,
    HUB,
    OBSERVER,
    RECORDER,
    STAGES,
    rows_of,
    thread_environment,
    threads_of,
)  # fmt: skip
from fieldpose.deploy.plan import Plan
from fieldpose.deploy.processes.collector import Collector
from fieldpose.deploy.processes.endpoints import check_free, free_port, peer_address
from fieldpose.deploy.processes.forking import FIELDPOSE
from fieldpose.deploy.processes.supervision import Program, Supervisor
from fieldpose.deploy.reporting.results import RunResult
from fieldpose.deploy.settings import to_json
from fieldpose.errors import OutputError, ProcessError, RecordingError
from fieldpose.stages.camera.sources import EXTERNAL

_START_S = 300.0
_RESTARTS_AT_START, _RESTARTS = 2, 10
_POLL_S = 0.1
_SETTLE_S = 0.2
_SETTINGS = "settings.json"
_STAGES_STOP_S, _RECORDER_STOP_S, _HUB_STOP_S = 2.0, 2.0, 0.5
"""Together under the 5 s after a Ctrl-C."""
_RECORDER_FINISHES_S = 60.0


@dataclass(frozen=True)
class Run:
    """A plan on this machine. `listen`: the hub's address (default: a free port); `logs`: a folder to keep."""

    plan: Plan
    record: Path | None = None
    listen: str | None = None
    logs: Path | None = None

    @property
    def processes(self) -> list[str]:
        """The processes of this run, the hub among them."""
        return [row.name for row in rows_of(self.plan, self.record is not None)]


@dataclass(frozen=True)
class Progress:
    """What a run is doing, for people to look at; `pids`: its processes by name; `hub`: where others can join it."""

    phase: Literal["starting", "running", "finishing"]
    waiting_for: tuple[str, ...] = ()
    sent: int = 0
    rate_hz: float = 0.0
    state: State | None = None
    restarts: int = 0
    pids: Mapping[str, int] = field(default_factory=dict)
    hub: str = ""


Report = Callable[[Progress], None]


def run_pipeline(run: Run, report: Report = lambda progress: None) -> RunResult:
    """Run the source to its end, or until Ctrl-C or SIGTERM, and end every process.

    Raises ProcessError where a process cannot start or does not stay up, TransportError for a bad or used address,
    RecordingError for a recording that is in the way or could not be finished.
    """
    _check_recording(run.record)
    check_free(run.listen)
    with StopSignals() as signals, _folder(run.logs) as folder:
        hub = run.listen or f"tcp/127.0.0.1:{free_port()}"
        with Supervisor(folder, programs(run, folder, hub), preloading(run, folder)) as supervisor:
            return _Running(run, supervisor, hub, signals, report).run()


def programs(run: Run, folder: Path, hub: str) -> list[Program]:
    """The command line and environment of each process; their settings are left in `folder`."""
    progress_file = folder / "camera-progress.json"
    progress_file.unlink(missing_ok=True)
    settings = run.plan.settings
    config = folder / _SETTINGS
    config.write_bytes(to_json(replace(settings, camera=replace(settings.camera, progress_file=progress_file))))
    listeners = (OBSERVER, RECORDER) if run.record is not None else (OBSERVER,)
    everyone = (*listeners, *(name for name in run.processes if name in STAGES and name != CAMERA))
    programs = []
    for name in run.processes:
        row = BY_NAME[name]
        threads = threads_of(row, run.plan.in_flight)
        command = [*FIELDPOSE, "stage", name, "--connect", hub, "--config", str(config)]
        if run.plan.field is not None:
            command += ["--field", str(run.plan.field.resolve())]
        command += ["--threads", str(threads)]
        if name == RECORDER and run.record is not None:
            command += ["--record", str(run.record.resolve()), "--wait-for", OBSERVER]
        elif name != HUB:
            command += ["--wait-for", *(everyone if name == CAMERA else listeners)]
        programs.append(Program(name, command, thread_environment(threads), row.stop_s, ends=name == CAMERA))
    return programs


def preloading(run: Run, folder: Path) -> tuple[str, ...]:
    """What is called before any process of a run is started, so that all of them share what it loads."""
    field = "" if run.plan.field is None else str(run.plan.field.resolve())
    return ("fieldpose.deploy.processes.preload:preload", str(folder / _SETTINGS), field, *run.processes)


class _Running:
    def __init__(self, run: Run, supervisor: Supervisor, hub: str, signals: StopSignals, report: Report) -> None:
        self._of, self._plan = run, run.plan
        self._supervisor = supervisor
        self._hub = hub
        self._stop = signals.stop
        self._report = report
        self._limit = _RESTARTS_AT_START
        self._pids: dict[str, int] = {}

    def run(self) -> RunResult:
        began = time.monotonic()
        bus = ZenohBus(self._hub, peer_address(self._hub))
        try:
            collector = Collector(bus, self._plan.settings.address)
            token = bus.hold(self._plan.settings.address.live(OBSERVER))
            start_s = self._start(bus, collector) - began
            # Where other programs send the frames, it is Ctrl-C that ends the source.
            finished = self._watch(collector) or self._plan.settings.camera.source == EXTERNAL
            self._finish(collector, finished)
            token.close()
            collector.close()
        finally:
            bus.close()
        return RunResult(
            frames=collector.results(),
            sent=collector.sent,
            stats=collector.stats,
            observed=collector.observed,
            restarts=dict(self._supervisor.restarts),
            plan=self._plan.notes,
            recording=_recording(self._of.record, self._supervisor),
            interrupted=not finished,
            start_s=start_s,
        )

    def _start(self, bus: ZenohBus, collector: Collector) -> float:
        """Return when all processes are ready, or are to be stopped; returns when that was."""
        address = self._plan.settings.address
        wanted = {address.live(name): name for name in self._of.processes if name != HUB}
        alive: set[str] = set()
        watching = bus.watch(address.live("*"), lambda key, up: (alive.add if up else alive.discard)(key))
        deadline = time.monotonic() + _START_S
        while not self._stop.is_set():
            waiting = tuple(name for key, name in wanted.items() if key not in alive)
            camera_finished = self._look(collector)
            if not waiting or camera_finished or collector.sent:
                break
            if time.monotonic() > deadline:
                raise ProcessError(f"not ready after {_START_S:g} s: {', '.join(waiting)}")
            self._report(Progress("starting", waiting, hub=self._hub))
            self._stop.wait(_POLL_S)
        watching.close()
        self._limit = _RESTARTS
        return time.monotonic()

    def _watch(self, collector: Collector) -> bool:
        """Look after the processes until the camera has finished; False where it was stopped before."""
        while not self._stop.is_set():
            if self._look(collector):
                return True
            self._report(self._progress(collector, "running"))
            self._stop.wait(_POLL_S)
        return False

    def _look(self, collector: Collector) -> bool:
        """Take in what has come and check on the processes; returns whether the camera has finished."""
        collector.update()
        processes = self._supervisor.check(self._limit)
        self._pids = {name: process.pid for name, process in processes.items() if process.pid}
        camera = processes.get(CAMERA)
        return camera is not None and camera.finished

    def _finish(self, collector: Collector, finished: bool) -> None:
        """End the stages, then the recorder, so that it has all that they said, then the hub."""
        self._report(self._progress(collector, "finishing"))
        time.sleep(_SETTLE_S)
        self._supervisor.stop(STAGES, _STAGES_STOP_S)
        time.sleep(_SETTLE_S)
        collector.update()
        self._supervisor.stop([RECORDER], _RECORDER_FINISHES_S if finished else _RECORDER_STOP_S)
        self._supervisor.stop([HUB], _HUB_STOP_S)

    def _progress(self, collector: Collector, phase: Literal["running", "finishing"]) -> Progress:
        return Progress(
            phase,
            sent=collector.sent,
            rate_hz=collector.rate_hz(time.time_ns()),
            state=collector.newest_state,
            restarts=sum(self._supervisor.restarts.values()),
            pids=self._pids,
        )


def _check_recording(path: Path | None) -> None:
    """Raise RecordingError for a recording that cannot be begun."""
    if path is None:
        return
    if partial_path(path).exists():
        raise RecordingError(
            f"{partial_path(path)}: an unfinished recording is in the way; `fieldpose recover {path}` saves what is"
            " in it, or remove it"
        )


def _recording(path: Path | None, supervisor: Supervisor) -> RecordingInfo | None:
    if path is None or not supervisor.has_run(RECORDER):
        return None
    if partial_path(path).exists() or not path.exists():
        raise RecordingError(f"{path}: the recording was not finished: {supervisor.last_line(RECORDER)}")
    return info(path)


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
        yield kept
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
