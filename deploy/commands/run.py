"""The whole pipeline on this machine, over a source of images."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Literal

import tyro

from fieldpose.deploy.access.joining import Entry
from fieldpose.deploy.plan import Plan, resolve
from fieldpose.deploy.processes.pipeline import Run, run_pipelines
from fieldpose.deploy.recording_options import RecordingOptions
from fieldpose.deploy.reporting.output import check_picture, check_writable, write_bytes, write_json
from fieldpose.deploy.reporting.report import live_line, print_plan, print_summary
from fieldpose.deploy.reporting.results import RunResult, summarise, to_csv
from fieldpose.deploy.reporting.trajectories import PoseFiles, Trajectory, in_words
from fieldpose.deploy.rig import planned_rig, read_rig
from fieldpose.deploy.settings import Settings, overridden
from fieldpose.deploy.viewing.beside import page_beside
from fieldpose.errors import RecordingError, UsageError
from fieldpose.stages.camera.config import Pace
from fieldpose.stages.nerf.field import load_field, load_metadata
from fieldpose.stages.nerf.training_views import training_views

INTERRUPTED = 130


@dataclass(frozen=True)
class Options:
    """Run the pipeline: a source of images through every stage, each a process of its own.

    Example: fieldpose run out/lego.safetensors --source dataset:../shared/data/lego:test
    --guess perturb:10-40deg,0.2 --record out/lego.mcap --json out/lego.json

    Several fields and several sources make several pipelines on one bus: every object is looked for in every camera's
    frames, and the JSON file has the figures of each under pipelines -> OBJECT/CAMERA. A configuration file may have a
    table [objects.NAME] with field = FILE for each object, and [cameras.NAME] with source = SOURCE for each camera,
    and in it what differs from the others.

    Ctrl-C ends the run and leaves a finished recording, which a second Ctrl-C does not wait for. What the keys of the
    JSON file mean stands in deploy/reporting/results.py.
    """

    field: Annotated[
        tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="FIELD ...", help_behavior_hint="")
    ] = ()
    """The field (.safetensors) of the object or scene; of several objects FILE or NAME=FILE each."""
    source: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """folder:DIR, dataset:DIR:test, video:FILE, camera:0, mcap:FILE or bag:FILE (of ROS); bus: other programs send the
    frames, see examples/; once for each of several cameras, as SOURCE or NAME=SOURCE (of one short for
    --camera.source)."""
    record: Path | None = None
    """Record every message into this file (.mcap)."""
    recording: Annotated[RecordingOptions, tyro.conf.arg(name="record")] = dataclasses.field(
        default_factory=RecordingOptions
    )
    json: Path | None = None
    """Write the figures of the run into this file."""
    csv: Path | None = None
    """Write a row for each frame into this file."""
    tum: Path | None = None
    """Write the poses that are sure as a trajectory of TUM's benchmark, object_from_cam, into this file; several
    pipelines each into its own, named after it."""
    colmap: Path | None = None
    """Write these poses and their cameras as a COLMAP model into this folder, the images named by their frame's number,
    as 00012.jpg; several pipelines each into its own."""
    plot: Path | None = None
    """Draw errors, scores, latencies and states over time into this file (.png, .svg or .pdf)."""
    report: Path | None = None
    """Write a page that tells of the run, with the frames that went worst as pictures, into this folder: report.html,
    or report-OBJECT-CAMERA.html for each of several pipelines; the run is recorded for it."""
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
    view: bool = False
    """Serve a page that shows the run while it lasts, and print its address; see `fieldpose view`."""
    listen: str | None = None
    """Address of the hub, for instance tcp/0.0.0.0:7447 (default: a free port of this machine); where other hosts reach
    it, --tls or --open is needed too."""
    entry: Annotated[Entry, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Entry)
    logs: Path | None = None
    """Keep the logs of the processes in this folder."""
    config: Path | None = None
    """TOML or JSON file of settings; flags win over it."""
    settings: Annotated[Settings, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Settings)

    @staticmethod
    def settings_of(config: Path) -> Settings:
        """The settings of a configuration file that may tell of several objects and cameras."""
        return read_rig(config)[0]

    def run(self) -> int:
        """Run, print the figures, write what was asked for."""
        plans = planned_rig(self.with_shortcuts(), read_rig(self.config)[1], self.field, self.source)
        titles = [_title(plan, len(plans) > 1) for plan in plans]
        if self.dry_run:
            for plan, title in zip(plans, titles, strict=True):
                print_plan(plan, title)
            return 0
        check_writable(self.record, self.json, self.csv, self._page)
        if self.report is not None and (self.recording.split is not None or self.recording.format == "foxglove"):
            raise UsageError("--report reads one recording of fieldpose's own; leave out --record.split and foxglove")
        check_picture(self.plot)
        files = [self._pose_files(plan, len(plans) > 1) for plan in plans]
        for file in files:
            file.check()
        named = titles[0] if len(plans) == 1 else f"{len(plans)} pipelines"
        with _recording_for(self.report, self.record) as recording:
            with page_beside(plans, self.listen, self.view, self.entry) as hub, live_line(named) as report:
                outcomes = run_pipelines(Run(plans, recording, hub, self.logs, self.recording, self.entry), report)
            self._write(plans, titles, outcomes)
            for plan, outcome, file in zip(plans, outcomes, files, strict=True):
                for line in file.write(Trajectory(plan.settings.address, _unit(plan), outcome.frames)):
                    print(line)
            if recording is not None:
                self._write_pages(plans, titles, outcomes, recording)
        check_recorded(outcomes[0])
        return INTERRUPTED if any(outcome.interrupted for outcome in outcomes) else 0

    def _write(self, plans: Sequence[Plan], titles: Sequence[str], outcomes: Sequence[RunResult]) -> None:
        """Print the figures, and write them."""
        figures = {}
        for plan, title, outcome in zip(plans, titles, outcomes, strict=True):
            pair = plan.settings.address.pair
            figures[pair] = summarise(outcome)
            print_summary(figures[pair], title)
            if self.plot is not None:
                draw(outcome, plan, _of_pipeline(self.plot, pair, len(plans) > 1), title)
        write_json(self.json, {"pipelines": figures} if len(plans) > 1 else next(iter(figures.values())))
        if self.csv is not None:
            rows = zip((plan.settings.address for plan in plans), (outcome.frames for outcome in outcomes), strict=True)
            write_bytes(self.csv, to_csv(rows))

    def _write_pages(
        self, plans: Sequence[Plan], titles: Sequence[str], outcomes: Sequence[RunResult], recording: Path
    ) -> None:
        if self._page is None:
            return
        from fieldpose.deploy.reporting.run_report import run_report

        for plan, title, outcome in zip(plans, titles, outcomes, strict=True):
            path = _of_pipeline(self._page, plan.settings.address.pair, len(plans) > 1)
            write_bytes(path, run_report(outcome, plan, title, recording))
            print(f"{path}: a page that tells of the run")

    @property
    def _page(self) -> Path | None:
        return None if self.report is None else self.report / "report.html"

    def _pose_files(self, plan: Plan, several: bool) -> PoseFiles:
        pair = plan.settings.address.pair
        return PoseFiles(
            None if self.tum is None else _of_pipeline(self.tum, pair, several),
            None if self.colmap is None else _of_pipeline(self.colmap, pair, several),
        )

    def with_shortcuts(self) -> Settings:
        """The settings with the short flags applied. Raises ConfigError for bad values."""
        s = self.settings
        return overridden(
            s,
            camera=overridden(s.camera, size=self.size, pace=self.pace),
            tracking=overridden(
                s.tracking, guess=self.guess, passes=self.passes, depth=self.depth, sequence=self.sequence
            ),
            matching=overridden(s.matching, matcher=self.matcher),
            refinement=overridden(s.refinement, when=self.refine),
        )


def check_recorded(outcome: RunResult) -> None:
    """Raise RecordingError where not everything of a run was recorded that should have been."""
    if outcome.recording_error is not None:
        raise RecordingError(outcome.recording_error)


@contextmanager
def _recording_for(folder: Path | None, record: Path | None) -> Iterator[Path | None]:
    """The recording that a report's pictures are taken from: the one asked for, or one in `folder` that is removed.

    None where neither is wanted.
    """
    if folder is None or record is not None:
        yield record
        return
    with TemporaryDirectory(prefix=".recording-", dir=folder) as temporary:
        yield Path(temporary) / "run.mcap"


def _title(plan: Plan, several: bool) -> str:
    source, address = plan.settings.camera.source, plan.settings.address
    return f"{address.object} in {address.camera} ({source})" if several else source


def _unit(plan: Plan) -> str:
    return in_words(None if plan.field is None else load_metadata(plan.field))


def _of_pipeline(path: Path, pair: str, several: bool) -> Path:
    return path.with_stem(f"{path.stem}-{pair.replace('/', '-')}") if several else path


def planned(settings: Settings, field: Path) -> Plan:
    """The plan of a run with a field's file. Raises FieldFileError, ConfigError, SourceError and DatasetError."""
    return resolve(settings, training_views(load_field(field)), field)


def draw(outcome: RunResult, plan: Plan, path: Path, title: str) -> None:
    """Draw a run over time. Raises OutputError."""
    from fieldpose.deploy.reporting.timeline import plot_timeline

    plot_timeline(outcome.frames, path, title, live=plan.settings.camera.pace == "live")
