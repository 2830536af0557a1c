"""How fast a moving camera is followed: by the processes over the bus, and by the same handlers in a plain loop."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from fieldpose.bus.messages import Frame, State
from fieldpose.deploy.benchmarks import machine
from fieldpose.deploy.commands.run import planned
from fieldpose.deploy.graph import AT_WORK, BY_NAME, threads_of
from fieldpose.deploy.local import LocalPipeline
from fieldpose.deploy.parts import Parts
from fieldpose.deploy.plan import Plan
from fieldpose.deploy.processes.pipeline import Progress, Run, run_pipeline
from fieldpose.deploy.reporting.results import RunResult, summarise
from fieldpose.deploy.scene import demo_file
from fieldpose.deploy.settings import Settings, changed
from fieldpose.errors import UsageError

FULL, DEFAULT = "full", "default"
_SETTINGS: dict[str, dict[str, Any]] = {
    # No pose is near enough to its guess, so that every frame has all its passes.
    FULL: {
        "tracking": {name: {"angle_deg": 0.0, "distance": 0.0} for name in ("settled", "far")},
        "rendering": {"size": 400},
        "refinement": {"when": "always"},
    },
    DEFAULT: {},
}
MODES: tuple[str, ...] = tuple(_SETTINGS)


def measure(modes: Sequence[str], frames: int | None, report: Callable[[str], None]) -> dict[str, Any]:
    """Everything that `fieldpose bench track` prints, as its JSON; of all frames of the sequence where None are named.

    Raises UsageError for a mode that there is not, KeyboardInterrupt after a Ctrl-C, and what `run_pipeline` raises.
    """
    for mode in modes:
        if mode not in MODES:
            raise UsageError(f"bench track: mode {mode!r}: expected {' or '.join(MODES)}")
    figures, loops = {}, {}
    for mode in modes:
        plan = plan_of(mode, frames)
        figures[mode] = _in_processes(plan, lambda text, mode=mode: report(f"{mode}: {text}"))  # type: ignore[misc]
        report(f"{mode}: in one process")
        loops[mode] = figures[mode]["plain_loop_rate_hz"] = _plain_loop_rate_hz(plan)
    return {
        "machine": machine.describe(),
        "modes": figures,
        "plain_loop_rate_hz": loops.get(FULL, next(iter(loops.values()), None)),
    }


def plan_of(mode: str, frames: int | None) -> Plan:
    """The demo's, with what the mode changes, over so many frames."""
    settings = changed(Settings(), _SETTINGS[mode], f"mode {mode}")
    camera = replace(settings.camera, source=f"mcap:{demo_file('sequence.mcap')}", frames=frames)
    return planned(replace(settings, camera=camera), demo_file("field.safetensors"))


def bus_share(run: RunResult) -> float | None:
    """Of the time of all frames from the camera's sending to their states, the share in which no process was at work.

    That is transport, decoding and waiting, for a place in a queue or for a core. None without any frame.
    """
    latency_s = sum(frame.latency_ms or 0.0 for frame in run.frames) / 1e3
    busy_s = sum(stats.busy_s for name, stats in run.stats.items() if name in AT_WORK)
    return max(0.0, 1.0 - busy_s / latency_s) if latency_s > 0 else None


def _in_processes(plan: Plan, report: Callable[[str], None]) -> dict[str, Any]:
    phases: list[str] = []

    def told(progress: Progress) -> None:
        if progress.phase not in phases:
            phases.append(progress.phase)
            report(progress.phase)

    with tempfile.TemporaryDirectory(prefix="fieldpose-") as folder:
        run = run_pipeline(Run(plan, Path(folder) / "recording.mcap"), told)
    if run.interrupted:
        raise KeyboardInterrupt
    return figures_of(run)


def figures_of(run: RunResult) -> dict[str, Any]:
    """The figures of `fieldpose run`, and those that a benchmark adds."""
    summary = summarise(run)
    return {
        **summary,
        "share_of_frames": summary["poses_ok"] / run.sent if run.sent else None,
        "bus_share": bus_share(run),
        "cpu_by_process": {name: stats["cpu_s"] for name, stats in summary["processes"].items()},
        "rss_mb_by_process": {name: stats["rss_mb"] for name, stats in summary["processes"].items()},
    }


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
