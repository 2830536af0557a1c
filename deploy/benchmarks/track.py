"""How well a moving camera is followed live by the processes, and how fast the same handlers are in a plain loop."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from fieldpose.bus.messages import Frame, State
from fieldpose.deploy.benchmarks import machine, sequences
from fieldpose.deploy.benchmarks.followed import Watcher, figures_of
from fieldpose.deploy.commands.run import planned
from fieldpose.deploy.graph import BY_NAME, threads_of
from fieldpose.deploy.local import LocalPipeline
from fieldpose.deploy.parts import Parts
from fieldpose.deploy.plan import Plan
from fieldpose.deploy.processes.pipeline import run_pipeline
from fieldpose.deploy.reporting.timeline import plot_timeline
from fieldpose.deploy.settings import Settings, changed
from fieldpose.errors import UsageError

DEFAULT, FULL = "default", "full"
ABLATIONS: dict[str, dict[str, Any]] = {
    DEFAULT: {},
    "following off": {"following": {"when": "never"}},
    "prefetch off": {"following": {"ahead": 0.0}},
    "adaptation off": {"following": {"budget": float("inf")}},
    # No pose is near enough to its guess, so that every frame has all its passes.
    FULL: {
        "following": {"when": "never"},
        "tracking": {name: {"angle_deg": 0.0, "distance": 0.0} for name in ("settled", "far")},
        "rendering": {"size": 400},
        "refinement": {"when": "always"},
    },
}
"""Changes of settings under the names by which they are measured."""

Report = Callable[[str], None]


@dataclass(frozen=True)
class Wanted:
    """How sequences are followed: with so many cores each, every so many-th frame, under so many ablations.

    frames: only so many, from the start (default: all). out: folder of the pictures.
    """

    cores: Sequence[int]
    steps: Sequence[int]
    ablations: Sequence[str]
    out: Path
    frames: int | None = None

    def __post_init__(self) -> None:
        for name in self.ablations:
            if name not in ABLATIONS:
                raise UsageError(f"bench track: ablation {name!r}: expected one of {', '.join(ABLATIONS)}")
        numbers = (*self.cores, *self.steps, 1 if self.frames is None else self.frames)
        if min(numbers) < 1 or not self.cores:
            raise UsageError("bench track: numbers of cores, steps and frames must be at least 1")
        if min(self.cores) > machine.cores():
            raise UsageError(f"bench track: this machine has {machine.cores()} cores")

    @property
    def cores_here(self) -> list[int]:
        """Those that this machine has, the most first."""
        return sorted({cores for cores in self.cores if cores <= machine.cores()}, reverse=True)


@dataclass(frozen=True)
class Case:
    """One run: of a sequence with so many cores, every so many-th frame, under an ablation."""

    sequence: sequences.Sequence
    cores: int
    step: int = 1
    ablation: str = DEFAULT
    frames: int | None = None

    @property
    def title(self) -> str:
        """What is measured, in words."""
        parts = [self.sequence.name, f"{self.cores} core{'s' if self.cores > 1 else ''}"]
        parts += [self.ablation] if self.ablation != DEFAULT else []
        return ", ".join([*parts, f"every {self.step}. frame"] if self.step > 1 else parts)

    @property
    def file_name(self) -> str:
        """Of its picture."""
        step = f"-step{self.step}" if self.step > 1 else ""
        ablation = f"-{self.ablation.replace(' ', '-')}" if self.ablation != DEFAULT else ""
        return f"track-{self.sequence.name}-{self.cores}{step}{ablation}.png"

    @property
    def plan(self) -> Plan:
        """What `fieldpose run` does with the sequence, with what the ablation changes."""
        settings = changed(Settings(), ABLATIONS[self.ablation], f"ablation {self.ablation}")
        source = f"mcap:{self.sequence.recording}"
        frames = None if self.frames is None else -(-self.frames // self.step)
        camera = replace(settings.camera, source=source, every=self.step, frames=frames)
        return planned(replace(settings, camera=camera), self.sequence.field)


def measure(chosen: Sequence[sequences.Sequence], wanted: Wanted, report: Report) -> dict[str, Any]:
    """Everything that `fieldpose bench track` prints, as its JSON.

    Raises KeyboardInterrupt after a Ctrl-C, and what `run_pipeline` raises.
    """
    figures = {one.name: _by_cores(one, wanted, report) for one in chosen}
    ablations = {DEFAULT: figures} if DEFAULT in wanted.ablations else {}
    for name in wanted.ablations:
        if name != DEFAULT:
            cases = [Case(one, wanted.cores_here[0], 1, name, wanted.frames) for one in chosen]
            ablations[name] = {
                case.sequence.name: {"cores": {str(case.cores): follow(case, wanted.out, report)}} for case in cases
            }
    report(f"{chosen[0].name}: in one process")
    with held_to(wanted.cores_here[0]):
        rate_hz = _plain_loop_rate_hz(Case(chosen[0], wanted.cores_here[0], 1, FULL, wanted.frames).plan)
    return {
        "machine": machine.describe(),
        "sequences": figures,
        "ablations": ablations,
        "plain_loop_rate_hz": rate_hz,
    }


def _by_cores(sequence: sequences.Sequence, wanted: Wanted, report: Report) -> dict[str, Any]:
    """With each number of cores; steps with the most of them alone."""
    by_cores = {
        cores: follow(Case(sequence, cores, frames=wanted.frames), wanted.out, report) for cores in wanted.cores_here
    }
    most, figures = next(iter(by_cores.items()))
    right = {1: figures["share_right"]}
    for step in wanted.steps:
        if step not in right:
            right[step] = follow(Case(sequence, most, step, frames=wanted.frames), wanted.out, report)["share_right"]
    figures["steps"] = {str(step): {"share_right": right[step]} for step in wanted.steps}
    return {"cores": {str(cores): measured for cores, measured in by_cores.items()}}


def follow(case: Case, out: Path, report: Report) -> dict[str, Any]:
    """Follow a sequence live, by real processes and without a recording, and draw it; returns its figures.

    Raises KeyboardInterrupt after a Ctrl-C, and what `run_pipeline` raises.
    """
    plan = case.plan
    with held_to(case.cores):
        watcher = Watcher(lambda phase: report(f"{case.title}: {phase}"))
        run = run_pipeline(plan, watcher)
    if run.interrupted:
        raise KeyboardInterrupt
    plot_timeline(run.frames, out / case.file_name, case.title)
    return figures_of(run, watcher, case.sequence.limit)


@contextmanager
def held_to(cores: int) -> Iterator[None]:
    """Hold this thread, and the processes that it starts, to so many of its cores."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(before)[:cores])
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def _plain_loop_rate_hz(plan: Plan) -> float:
    """Frames a second in this process, one after the other, from the first sent to the last answered."""
    settings = plan.settings
    lockstep = replace(plan, settings=replace(settings, camera=replace(settings.camera, pace="lockstep")))
    parts = Parts(lockstep, threads_of(BY_NAME["matching"], depth=1), together=True)
    pipeline = LocalPipeline(parts, with_camera=True)
    sent, answered = [], []
    for said in pipeline.play():
        if isinstance(said.message, Frame):
            sent.append(said.message.header.sent_ns)
        elif isinstance(said.message, State):
            answered.append(said.message.header.sent_ns)
    pipeline.close()
    return len(answered) / ((answered[-1] - sent[0]) / 1e9) if answered else 0.0
