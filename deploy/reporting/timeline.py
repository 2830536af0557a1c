"""A picture of a run over time: how far each pose is from the truth, how late it came, what frames were missed."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from pathlib import Path
from typing import Literal

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from fieldpose.deploy.reporting.output import write_bytes
from fieldpose.deploy.reporting.results import FrameResult
from fieldpose.stages.geometry import rotation_error_deg, translation_error

STATE_COLOURS = {"initializing": "#9aa5b1", "tracking": "#4caf6d", "limited": "#f2b134", "lost": "#d9534f"}
_FOUND, _CARRIED, _MISSED = "#1f4e79", "#9467bd", "#c0392b"
_WIDTH, _PANEL, _LOW, _STRIP, _AROUND = 11.0, 1.8, 0.9, 0.6, 1.35
_LAST_S = 0.02
_FEW = 100.0
_DPI = 110

Timed = Sequence[tuple[float, FrameResult]]
"""Frames, each with its time in seconds since the first."""
Value = Callable[[FrameResult], float | None]


@dataclass(frozen=True)
class _Panel:
    """What is drawn of each frame, and of those whose pose was carried on; None where it is not known."""

    label: str
    value: Value
    carried: Value = lambda frame: None
    scale: Literal["linear", "log"] = "linear"
    style: str = "."
    limits: tuple[float, float] | None = None
    height: float = _PANEL


def plot_timeline(frames: Sequence[FrameResult], path: Path, title: str, live: bool = True) -> None:
    """Write a .png, .svg or .pdf of what `timeline` draws. Raises OutputError."""
    write_bytes(path, timeline(frames, path.suffix.removeprefix("."), title, live))


def timeline(frames: Sequence[FrameResult], kind: str, title: str, live: bool = True) -> bytes:
    """A png, svg or pdf; frames are oldest first. Panels of which nothing is known are left out.

    live: frames were sent as they were captured, so that latencies can be from their capture; else they are from
    their sending.
    """
    start_ns = frames[0].capture_ns if frames else 0
    timed = [((frame.capture_ns - start_ns) / 1e9, frame) for frame in frames]
    panels = [panel for panel in _panels(live) if _points(timed, panel.value)]
    heights = [_STRIP, *(panel.height for panel in panels)]
    drawing = Figure(figsize=(_WIDTH, sum(heights) + _AROUND), layout="constrained")
    strip, *axes = np.atleast_1d(drawing.subplots(len(heights), sharex=True, height_ratios=heights))
    _draw_strip(strip, timed)
    for axis, panel in zip(axes, panels, strict=True):
        _draw_panel(axis, panel, timed)
    [strip, *axes][-1].set_xlabel("seconds since the first frame")
    strip.set_xlim(0, max([at for at, _ in timed], default=0.0) + _LAST_S)
    drawing.align_ylabels()
    _draw_legend(drawing)
    drawing.suptitle(f"{title}\n{_in_words(frames, live)}", fontsize=10, parse_math=False)
    return file_of(drawing, kind)


def _panels(live: bool) -> list[_Panel]:
    def turn(pose: np.ndarray | None, frame: FrameResult) -> float | None:
        return None if pose is None or frame.true_pose is None else rotation_error_deg(pose, frame.true_pose)

    def shift(pose: np.ndarray | None, frame: FrameResult) -> float | None:
        return None if pose is None or frame.true_pose is None else translation_error(pose, frame.true_pose)

    return [
        _Panel("rotation error,\ndegrees", lambda f: turn(f.cam_from_object, f), lambda f: turn(f.carried, f), "log"),
        _Panel(
            "translation error,\nunits", lambda f: shift(f.cam_from_object, f), lambda f: shift(f.carried, f), "log"
        ),
        _Panel(
            "score, 0 to 1", lambda f: None if f.cam_from_object is None else f.score, limits=(-0.05, 1.05), height=_LOW
        ),
        _Panel(
            f"{'capture' if live else 'sending'}\nto state, ms",
            lambda f: f.age_ms if live else f.latency_ms,
            scale="log",
        ),
        _Panel("adaptation\nlevel", lambda f: f.level, style="-", height=_LOW),
    ]


def _points(timed: Timed, value: Value) -> list[tuple[float, float]]:
    return [(at, known) for at, frame in timed if (known := value(frame)) is not None]


def _draw_strip(axis: Axes, timed: Timed) -> None:
    """The states as bands, and below them a tick for each frame that has got no answer."""
    counts = Counter(frame.state for _, frame in timed)
    for state, spans in state_spans(timed).items():
        told = f"{state} {counts[state]}x"
        axis.broken_barh(spans, (0.45, 0.55), color=STATE_COLOURS[state], linewidth=0, label=told)
    for outcome, colour in (("dropped", _MISSED), ("lost", "black")):
        missed = [at for at, frame in timed if frame.outcome == outcome]
        if missed:
            axis.vlines(missed, 0.0, 0.38, color=colour, linewidth=0.9, label=f"frame {outcome} {len(missed)}x")
    axis.set_ylim(0, 1)
    axis.set_yticks([0.19, 0.72], ["missed", "state"], fontsize=9)
    axis.tick_params(length=0)


def state_spans(timed: Timed) -> dict[str, list[tuple[float, float]]]:
    """Of each state (start, length) in seconds: from the first frame that had it to the first that had another."""
    known = [(at, frame.state) for at, frame in timed if frame.state is not None]
    changes = [next(run) for _, run in groupby(known, key=lambda one: one[1])]
    spans: dict[str, list[tuple[float, float]]] = {}
    for (at, state), (end, _) in pairwise([*changes, (timed[-1][0] + _LAST_S, "")] if changes else []):
        spans.setdefault(state, []).append((at, end - at))
    return {state: spans[state] for state in STATE_COLOURS if state in spans}


def _draw_panel(axis: Axes, panel: _Panel, timed: Timed) -> None:
    for state, spans in state_spans(timed).items():
        axis.broken_barh(
            spans, (0, 1), transform=axis.get_xaxis_transform(), color=STATE_COLOURS[state], alpha=0.16, linewidth=0
        )
    axis.set_yscale(panel.scale)
    for value, colour, label in ((panel.value, _FOUND, "pose measured"), (panel.carried, _CARRIED, "carried on")):
        points = _points(timed, value)
        if points:
            axis.plot(*zip(*points, strict=True), panel.style, color=colour, markersize=4, label=label)
    if panel.limits is not None:
        axis.set_ylim(*panel.limits)
    if panel.scale == "log":
        _label_decades(axis)
    axis.set_ylabel(panel.label, fontsize=9)
    axis.grid(visible=True, alpha=0.35)


def _label_decades(axis: Axes) -> None:
    """Plain numbers, on an axis of at least one decade."""
    low, high = axis.get_ylim()
    around = max(1.0, (10 * low / high) ** 0.5)
    axis.set_ylim(low / around, high * around)
    axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < _FEW * low else (1,)))
    axis.yaxis.set_major_formatter("{x:g}")
    axis.yaxis.set_minor_formatter(NullFormatter())


def _draw_legend(drawing: Figure) -> None:
    named: dict[str, Artist] = {}
    for axis in reversed(drawing.axes):  # the upper panels' marks are those that are told
        handles, labels = axis.get_legend_handles_labels()
        named.update(zip(labels, handles, strict=True))
    drawing.legend(
        list(named.values()), list(named), loc="outside lower center", ncols=len(named) or 1, fontsize=9, frameon=False
    )


def _in_words(frames: Sequence[FrameResult], live: bool) -> str:
    outcomes = Counter(frame.outcome for frame in frames)
    found = sum(frame.cam_from_object is not None for frame in frames)
    words = [f"{len(frames)} frames, {found} with a pose", f"{outcomes['dropped']} dropped, {outcomes['lost']} lost"]
    errors = [frame.errors for frame in frames if frame.errors is not None]
    if errors:
        turn, shift = np.median(errors, axis=0)
        words.append(f"median error {turn:.3g} degrees, {shift:.3g} units")
    latencies = [late for frame in frames if (late := frame.age_ms if live else frame.latency_ms) is not None]
    if latencies:
        words.append("latency {:.0f} ms (50 %), {:.0f} ms (90 %)".format(*np.percentile(latencies, (50, 90))))
    return "; ".join(words)


def file_of(drawing: Figure, kind: str) -> bytes:
    """The content of a png, svg or pdf."""
    content = io.BytesIO()
    drawing.savefig(content, dpi=_DPI, format=kind)
    return content.getvalue()
