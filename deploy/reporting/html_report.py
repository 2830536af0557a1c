"""The page of a run: figures in, the file's bytes out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import chi2

from fieldpose.deploy.evaluation.scores import DIMENSIONS, coverage
from fieldpose.deploy.reporting.html_page import (
    columns,
    figure,
    gallery,
    lines,
    page,
    plot,
    section,
    soft,
    table,
    tiles,
)
from fieldpose.deploy.reporting.report import STAGE_COLUMNS, STAGES_TITLE, rows, stage_rows
from fieldpose.deploy.reporting.results import FrameResult
from fieldpose.deploy.reporting.timeline import file_of, timeline
from fieldpose.deploy.reporting.worst import Bad, squared_distances
from fieldpose.stages.tracking.scoring import deviations

_FOUND, _SAID = "#1f4e79", "#e08214"


@dataclass(frozen=True)
class Report:
    """What a page tells of one pipeline's run.

    summary: as of `summarise`. live: see `timeline`. worst: each with its picture (h, w, 3) uint8 RGB, None where there
    is none. settings: those that are not the defaults. decided: what was left open, and what was made of it. made_with:
    the machine and versions. field_lines: what the field says of itself.
    """

    source: str
    field_name: str
    summary: Mapping[str, Any]
    frames: Sequence[FrameResult] = ()
    live: bool = True
    interrupted: bool = False
    worst: Sequence[tuple[Bad, np.ndarray | None]] = ()
    field_lines: Sequence[str] = ()
    settings: Mapping[str, str] = field(default_factory=dict)
    decided: Mapping[str, str] = field(default_factory=dict)
    made_with: Mapping[str, str] = field(default_factory=dict)


def html(report: Report) -> bytes:
    """The page. Everything in it is text or a picture: it runs no script and asks nothing from anywhere."""
    sections = [
        tiles(_tiles(report.summary)),
        section("Over time", _timeline(report)),
        section("The frames that went worst", _worst(report)),
        section("Figures", table(rows(report.summary))),
        section(STAGES_TITLE.capitalize(), columns(STAGE_COLUMNS, stage_rows(report.summary))),
        section("How true the stated covariances are", _covariances(report.frames)),
        section("The field", lines(report.field_lines)),
        section("What was decided", table(report.decided.items())),
        section(
            "Settings that are not the defaults, once all is decided", table(report.settings.items()) or soft("none")
        ),
        section("Made with", table(report.made_with.items())),
    ]
    note = "The run was interrupted before its source had ended." if report.interrupted else ""
    return page("fieldpose run", report.source, [f"looked for with {report.field_name}"], "".join(sections), note)


def _tiles(summary: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    frames, found = summary["frames"], summary["poses_ok"]
    yield f"{found / frames:.1%}" if frames else "-", f"of {frames} frames have a pose"
    for key, unit, what in (
        ("rotation_error_deg", "°", "rotation error, median"),
        ("translation_error", "", "translation error, median, units"),
    ):
        if summary[key] is not None:
            yield f"{summary[key]['median']:.3g}{unit}", what
    latency = summary["latency_ms"]["p50"]
    yield "-" if latency is None else f"{latency:.0f} ms", "latency, median"
    yield f"{summary['rate_hz']:.1f}", "frames a second"
    yield str(summary["dropped_at_the_door"]), "frames dropped at the door"


def _timeline(report: Report) -> str:
    if not report.frames:
        return soft("no frame has come")
    return plot(timeline(report.frames, "png", report.source, report.live), "Errors, scores and latencies over time")


def _worst(report: Report) -> str:
    if not report.worst:
        return soft("none: no frame was worked on")
    started_ns = report.frames[0].capture_ns if report.frames else 0
    return gallery(_frame(bad, pixels, started_ns) for bad, pixels in report.worst)


def _frame(bad: Bad, pixels: np.ndarray | None, started_ns: int) -> str:
    named = f"frame {bad.result.frame_id}, {(bad.result.capture_ns - started_ns) / 1e9:.2f} s"
    row = f" ({bad.in_a_row} in a row)" if bad.in_a_row > 1 else ""
    return figure(pixels, named, f"{row}: {bad.why}")


def _covariances(frames: Sequence[FrameResult]) -> str:
    squared = squared_distances(frames)
    inside = coverage(squared)
    if inside is None:
        return ""
    counts = (
        (f"{p} %", f"{share * len(squared):.0f} of {len(squared)}", f"{share:.1%}") for p, share in inside.items()
    )
    told = "Errors and their stated deviations; true poses by region"
    drawn = plot(_drawn_covariances(frames, squared), told)
    return columns(("region", "true poses inside it", "share"), counts) + drawn


def _drawn_covariances(frames: Sequence[FrameResult], squared: Sequence[float]) -> bytes:
    """Each error with its stated standard deviation over time, and the share of true poses inside each region."""
    known = [frame for frame in frames if frame.errors is not None and frame.covariance is not None]
    at = [(frame.capture_ns - frames[0].capture_ns) / 1e9 for frame in known]
    errors = np.array([frame.errors for frame in known])
    said = np.array([deviations(frame.covariance) for frame in known if frame.covariance is not None])[:, ::-1]
    drawing = Figure(figsize=(11.0, 4.2), layout="constrained")
    axes = drawing.subplot_mosaic([["turn", "regions"], ["shift", "regions"]], width_ratios=(3, 2))
    above, below, axis = axes["turn"], axes["shift"], axes["regions"]
    for part, which, label in ((above, 0, "rotation,\ndegrees"), (below, 1, "translation,\nunits")):
        part.semilogy(at, errors[:, which], ".", color=_FOUND, markersize=4, label="error")
        part.semilogy(at, said[:, which], "-", color=_SAID, linewidth=1, label="stated standard deviation")
        _framed(part, "", label)
    below.set_xlabel("seconds since the first frame")
    above.legend(fontsize=8, loc="upper right")
    regions = np.linspace(0, 1, 101)
    axis.plot([0, 1], [0, 1], "--", color="black", linewidth=0.8, label="as stated")
    axis.plot(
        regions, [np.mean(np.array(squared) <= limit) for limit in chi2.ppf(regions, DIMENSIONS)], color=_FOUND,
        label="found",
    )  # fmt: skip
    _framed(axis, "probability of the region", "share of true poses inside")
    axis.legend(fontsize=8, loc="upper left")
    return file_of(drawing, "png")


def _framed(axis: Axes, x_label: str, y_label: str) -> None:
    axis.set_xlabel(x_label, fontsize=9)
    axis.set_ylabel(y_label, fontsize=9)
    axis.grid(visible=True, alpha=0.35)
