"""What the page of a run is made of: its results, its plan, and pictures from its recording."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fieldpose.deploy.benchmarks.machine import describe
from fieldpose.deploy.plan import Plan
from fieldpose.deploy.reporting.fields import field_in_words
from fieldpose.deploy.reporting.html_report import Report, html
from fieldpose.deploy.reporting.provenance import made_with
from fieldpose.deploy.reporting.results import RunResult, summarise
from fieldpose.deploy.reporting.showing import pictures_of
from fieldpose.deploy.reporting.worst import Bad, worst
from fieldpose.deploy.settings import differing
from fieldpose.stages.nerf.field import load_field
from fieldpose.stages.nerf.loading import load_renderer


def run_report(outcome: RunResult, plan: Plan, title: str, recording: Path) -> bytes:
    """The page of a pipeline's run, recorded in that file. Raises RecordingError, OutputError and FieldFileError."""
    bad = worst(outcome.frames)
    shown = _pictures(bad, plan, recording) if bad and outcome.recording is not None else {}
    return html(
        Report(
            source=title,
            field_name="no field of its own" if plan.field is None else plan.field.name,
            summary=summarise(outcome),
            frames=outcome.frames,
            live=plan.settings.camera.pace == "live",
            interrupted=outcome.interrupted,
            worst=[(each, shown.get((each.result.frame_id, each.result.capture_ns))) for each in bad],
            field_lines=[] if plan.field is None else list(field_in_words(plan.field, load_field(plan.field))),
            settings=differing(plan.settings),
            decided=plan.notes,
            made_with={"machine": describe(), **_versions(plan)},
        )
    )


def _pictures(bad: Sequence[Bad], plan: Plan, recording: Path) -> dict[tuple[int, int], np.ndarray]:
    """By number and capture time of the frame, (h, w, 3) uint8 RGB."""
    if plan.field is None:
        return {}
    renderer = load_renderer(plan.field, threads=0, backend=plan.settings.backend)
    results = [each.result for each in bad]
    shown = pictures_of(recording, results, renderer, plan.settings.address)
    return {(picture.result.frame_id, picture.result.capture_ns): picture.pixels for picture in shown}


def _versions(plan: Plan) -> dict[str, str]:
    noted = made_with(plan)
    noted["system"] = noted.pop("machine")
    return noted
