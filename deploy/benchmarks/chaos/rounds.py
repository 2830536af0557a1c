"""Runs of the demo scene in which things go wrong."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import psutil

from fieldpose.bus.open_recording import unfinished_file
from fieldpose.bus.recording import RecordingWriter
from fieldpose.deploy.benchmarks.chaos.events import Event, Kind, Round
from fieldpose.deploy.benchmarks.chaos.injector import SETTLED_S, Injector
from fieldpose.deploy.benchmarks.chaos.judging import Verdict, Wrong, back_s, judged, wrong
from fieldpose.deploy.benchmarks.sequences import Sequence as Followed
from fieldpose.deploy.benchmarks.sequences import there_and_back
from fieldpose.deploy.commands.run import planned
from fieldpose.deploy.evaluation.film import FrameLog
from fieldpose.deploy.plan import Plan
from fieldpose.deploy.processes.pipeline import Run, run_pipelines
from fieldpose.deploy.reporting.results import RunResult
from fieldpose.deploy.settings import Settings
from fieldpose.errors import ProcessError
from fieldpose.stages.camera.config import CameraConfig

_RATE_HZ = 30.0


@dataclass
class Played:
    """What a round has shown. problems: those of the run as a whole; left: events that its source was too short for."""

    verdicts: list[Verdict]
    wrong: list[Wrong] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    left: Sequence[Event] = ()
    frames: int = 0
    start_s: float | None = None


def film(path: Path, recording: Path, seconds: float) -> Path:
    """A recording of so many seconds with the frames of another and their true poses, there and back again."""
    lap = there_and_back(recording)
    writer = RecordingWriter(path)
    log = FrameLog(writer)
    for i in range(round(seconds * _RATE_HZ)):
        log.write(replace(lap[i % len(lap)], frame_id=i, at_ns=round(i * 1e9 / _RATE_HZ)))
    writer.close()
    return path


def plan_of(followed: Followed, source: Path) -> Plan:
    """The plan of a run of a film."""
    return planned(replace(Settings(), camera=CameraConfig(f"mcap:{source}")), followed.field)


def play(one: Round, source: Path, followed: Followed, settled_s: float = SETTLED_S) -> Played:
    """Run the pipeline while the events of a round happen, and judge. Raises KeyboardInterrupt after a Ctrl-C.

    settled_s: see Injector.
    """
    injector = Injector([event for event in one.events if event.kind is not Kind.ORDER], settled_s)
    with tempfile.TemporaryDirectory(prefix="fieldpose-chaos-") as folder:
        recording = Path(folder) / "run.mcap"
        run = Run((plan_of(followed, source),), recording, order=one.order)
        try:
            (outcome,) = run_pipelines(run, injector)
        except ProcessError as error:
            played = _ended(injector, str(error))
        else:
            if outcome.interrupted and not injector.stopped:
                raise KeyboardInterrupt
            played = _went_on(one, injector, outcome, followed)
        played.problems += _left_behind(injector, recording)
        return played


def _went_on(one: Round, injector: Injector, outcome: RunResult, followed: Followed) -> Played:
    verdicts = judged(injector.done, outcome.frames, outcome.faults)
    left = injector.not_done
    if one.events[0].kind is Kind.ORDER:
        verdicts = [_started(one.events[0], outcome)]
    elif injector.done and injector.done[-1].event.ends_run:
        verdicts[-1].problems = ["the run went on as if nothing had been"]
    return Played(verdicts, wrong(outcome.frames, followed.limit), [], left, outcome.sent, outcome.start_s)


def _started(event: Event, outcome: RunResult) -> Verdict:
    """A start in another order: all the first frames must be there, and no process may have fallen."""
    sent = [frame.sent_ns for frame in outcome.frames if frame.sent_ns is not None]
    verdict = Verdict(event, back_s(outcome.frames, min(sent, default=0)), outcome.start_s)
    verdict.judge_time()
    if outcome.faults:
        verdict.problems.append(f"{len(outcome.faults)} processes fell")
    return verdict


def _ended(injector: Injector, said: str) -> Played:
    """A run that ended with an error: as it must where its supervisor is gone, with one line that tells so."""
    verdicts = [Verdict(done.event) for done in injector.done]
    last = verdicts[-1] if verdicts else Verdict(Event(Kind.ORDER))
    if not last.event.ends_run:
        last.problems.append(f"the run ended: {said}")
    elif "\n" in said or "supervisord" not in said:
        last.problems.append(f"told in other words: {said}")
    return Played(verdicts or [last], left=injector.not_done)


def _left_behind(injector: Injector, recording: Path) -> list[str]:
    """What a run must not leave: processes, shared memory, its folder, an unfinished recording."""
    found = []
    if injector.folder is not None:
        alive = [p.pid for p in psutil.process_iter() if _belongs(p, injector.folder)]
        found += [f"{len(alive)} processes left"] if alive else []
        found += [f"folder left: {injector.folder}"] if injector.folder.exists() else []
    segments = [path for path in injector.segments if path.exists()]
    found += [f"{len(segments)} segments of shared memory left"] if segments else []
    if unfinished_file(recording) is not None:
        found.append("an unfinished recording is left")
    elif not recording.exists():
        found.append("no recording is left")
    return found


def _belongs(process: psutil.Process, folder: Path) -> bool:
    try:
        return process.status() != psutil.STATUS_ZOMBIE and str(folder) in " ".join(process.cmdline())
    except psutil.Error:
        return False
