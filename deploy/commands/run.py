"""The whole pipeline on this machine, over a source of images."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from fieldpose.deploy.plan import Plan, resolve
from fieldpose.deploy.processes.pipeline import Run, run_pipeline
from fieldpose.deploy.reporting.output import check_picture, check_writable, write_bytes, write_json
from fieldpose.deploy.reporting.report import live_line, print_plan, print_summary
from fieldpose.deploy.reporting.results import RunResult, summarise, to_csv
from fieldpose.deploy.settings import Settings, overridden
from fieldpose.errors import UsageError
from fieldpose.stages.camera.config import Pace
from fieldpose.stages.nerf.field import load_field
from fieldpose.stages.nerf.training_views import training_views

INTERRUPTED = 130


@dataclass(frozen=True)
class Options:
    """Run the pipeline: a source of images through every stage, each a process of its own.

    Example: fieldpose run out/lego.safetensors --source dataset:../shared/data/lego:test
    --guess perturb:10-40deg,0.2 --record out/lego.mcap --json out/lego.json

    Ctrl-C ends the run and leaves a finished recording. What the keys of the JSON file mean stands in
    deploy/reporting/results.py.
    """

    field: tyro.conf.Positional[Path]
    """The field (.safetensors) of the object or scene."""
    source: str | None = None
    """folder:DIR, dataset:DIR:test, video:FILE, camera:0 or mcap:FILE; bus: other programs send the frames, see
    examples/ (short for --camera.source)."""
    record: Path | None = None
    """Record every message into this file (.mcap)."""
    json: Path | None = None
    """Write the figures of the run into this file."""
    csv: Path | None = None
    """Write a row for each frame into this file."""
    plot: Path | None = None
    """Draw errors, scores, latencies and states over time into this file (.png, .svg or .pdf)."""
    guess: str | None = None
    """Where to begin: perturb:10-40deg,0.2 (each frame's true pose, disturbed), train:NAME, or a JSON file; without
    it, training views that look like the frame (short for --tracking.guess)."""
    size: int | None = None
    """Shrink images whose longer side has more pixels (short for --camera.size)."""
    pace: Pace | None = None
    """live: by the source's own times; lockstep: a frame when the one before is answered; fast: at once (short
    for --camera.pace)."""
    sequence: Literal["auto", "video", "photos"] | None = None
    """Photos stand each by itself, in videos the motion carries on; auto: in videos, recordings and from cameras (short
    for --tracking.sequence)."""
    dry_run: bool = False
    """Print what would be run, with everything that was left open decided, and run nothing."""
    passes: int | None = None
    """Most passes over a frame (short for --tracking.passes)."""
    depth: int | None = None
    """Frames solved at once, where they are not followed (short for --tracking.depth)."""
    matcher: str | None = None
    """xfeat, xfeat-lighterglue, aliked-lightglue, disk-lightglue, loftr or sift (short for --matching.matcher)."""
    refine: Literal["auto", "always", "never"] | None = None
    """Whether to refine poses by colours; auto: not in videos (short for --refinement.when)."""
    listen: str | None = None
    """Address of the hub, for instance tcp/0.0.0.0:7447 (default: a free port of this machine)."""
    logs: Path | None = None
    """Keep the logs of the processes in this folder."""
    config: Path | None = None
    """TOML or JSON file of settings; flags win over it."""
    settings: Annotated[Settings, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Settings)

    def run(self) -> int:
        """Run, print the figures, write what was asked for."""
        plan = planned(self.with_shortcuts(), self.field)
        source = plan.settings.camera.source
        if self.dry_run:
            print_plan(plan)
            return 0
        check_writable(self.record, self.json, self.csv)
        check_picture(self.plot)
        with live_line(source) as report:
            outcome = run_pipeline(Run(plan, self.record, self.listen, self.logs), report)
        give_out(outcome, source, self.json, self.csv)
        if self.plot is not None:
            draw(outcome, plan, self.plot, source)
        return INTERRUPTED if outcome.interrupted else 0

    def with_shortcuts(self) -> Settings:
        """The settings with the short flags applied. Raises UsageError, and ConfigError for bad values."""
        s = self.settings
        camera = overridden(s.camera, source=self.source, size=self.size, pace=self.pace)
        if not camera.source:
            raise UsageError("no source of images; give --source, for instance --source folder:DIR")
        return overridden(
            s,
            camera=camera,
            tracking=overridden(
                s.tracking, guess=self.guess, passes=self.passes, depth=self.depth, sequence=self.sequence
            ),
            matching=overridden(s.matching, matcher=self.matcher),
            refinement=overridden(s.refinement, when=self.refine),
        )


def planned(settings: Settings, field: Path) -> Plan:
    """The plan of a run with a field's file. Raises FieldFileError, ConfigError, SourceError and DatasetError."""
    return resolve(settings, training_views(load_field(field)), field)


def give_out(outcome: RunResult, title: str, json: Path | None, csv: Path | None = None) -> dict[str, object]:
    """Print and write the figures of a run; returns them."""
    summary = summarise(outcome)
    print_summary(summary, title)
    write_json(json, summary)
    if csv is not None:
        write_bytes(csv, to_csv(outcome.frames))
    return summary


def draw(outcome: RunResult, plan: Plan, path: Path, title: str) -> None:
    """Draw a run over time. Raises OutputError."""
    from fieldpose.deploy.reporting.timeline import plot_timeline

    plot_timeline(outcome.frames, path, title, live=plan.settings.camera.pace == "live")
