"""How a run is shown to people: a line that lives while it lasts, and a table at its end."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from rich.table import Table

from fieldpose.deploy.plan import Plan
from fieldpose.deploy.processes.pipeline import Progress, Standing
from fieldpose.deploy.reporting.output import progress_console, result_console
from fieldpose.deploy.reporting.reasons import reason_in_words

_MISSING = "-"
STAGES_TITLE = "latency by stage, waiting included (ms)"
STAGE_COLUMNS = ("stage", "p50", "p90", "its own work, p50", "cpu s", "memory MB")
CAMERA_ORIGINS = {
    "calibrated": "from a calibration", "training": "of the training views", "exif": "from EXIF",
    "assumed": "with an ASSUMED field of view, so that no pose is sure; give --camera.camera-file",
}  # fmt: skip
"""Where a frame's intrinsics come from, in words."""
_FAULTS = {"hung": "hung and was replaced", "ended": "ended unasked"}


@contextmanager
def live_line(title: str) -> Iterator[Callable[[Progress], None]]:
    """Gives a function that shows a run's progress on stderr, and once, above it, where other programs find the hub."""
    console = progress_console()
    phase, told = "", 0
    with console.status(title) as status:

        def report(progress: Progress) -> None:
            nonlocal phase, told
            if progress.phase == "starting" != phase:
                console.print(f"{title}: hub {progress.hub}", highlight=False, soft_wrap=True)
            if progress.phase != phase and not console.is_terminal:
                console.print(f"{title}: {progress.phase}", highlight=False)
            for name in progress.hung[told:]:
                console.print(f"{title}: {name} hung, was killed and is started again", highlight=False, soft_wrap=True)
            phase, told = progress.phase, len(progress.hung)
            status.update(f"{title}: {_in_words(progress)}")

        yield report


def _in_words(progress: Progress) -> str:
    if progress.phase == "starting":
        return f"starting, waiting for {', '.join(progress.waiting_for) or 'the camera'}"
    if progress.phase == "finishing":
        return "finishing"
    words = [_standing(standing, named=len(progress.standings) > 1) for standing in progress.standings]
    if progress.hung:
        words.append(f"{len(progress.hung)} hung and replaced")
    if progress.restarts:
        words.append(f"{progress.restarts} restarts")
    return (" | " if len(progress.standings) > 1 else ", ").join(words)


def _standing(standing: Standing, named: bool) -> str:
    words = [f"{standing.sent} frames sent", f"{standing.rate_hz:.1f} poses/s"]
    state = standing.state
    if state is not None:
        words.append(str(state.state))
        if not named:
            words += [f"{state.in_flight} in flight", f"{state.dropped_at_the_door} dropped at the door"]
    return f"{standing.address.pair}: {', '.join(words)}" if named else ", ".join(words)


def print_plan(plan: Plan, title: str) -> None:
    """Print what was decided for a run, on stdout."""
    table = Table(title=f"plan for {title}", show_header=False, title_justify="left")
    for name, decision in plan.notes.items():
        table.add_row(name, decision)
    result_console().print(table)


def print_summary(summary: Mapping[str, Any], title: str) -> None:
    """Print the tables of a run's summary on stdout."""
    console = result_console()
    console.print(_figures(summary, title))
    console.print(_stages(summary))


def _figures(summary: Mapping[str, Any], title: str) -> Table:
    table = Table(title=title, show_header=False, title_justify="left")
    table.add_column("what")
    table.add_column("value", justify="right")
    for what, value in rows(summary):
        table.add_row(what, value)
    return table


def rows(summary: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """The figures of a run's summary in words: what, and its value."""
    sent, dropped = summary["frames_sent"], summary["dropped_at_the_door"]
    yield "frames sent / dropped at the door", f"{sent} / {dropped}"
    yield "frames / with a pose / lost", f"{summary['frames']} / {summary['poses_ok']} / {summary['frames_lost']}"
    if summary["frames_forgotten"]:
        yield "frames before, in no figure below", str(summary["frames_forgotten"])
    if summary["reasons"]:
        reasons = ", ".join(f"{reason_in_words(reason)} {count}x" for reason, count in summary["reasons"].items())
        yield "not sure, or without a pose, because", reasons
    if summary["cameras"].keys() - {"calibrated"}:
        yield (
            "camera taken from",
            ", ".join(f"{CAMERA_ORIGINS[origin]} {count}x" for origin, count in summary["cameras"].items()),
        )
    for key, what, unit in (
        ("rotation_error_deg", "rotation error: median, mean, p90", "deg"),
        ("translation_error", "translation error: median, mean, p90", "units"),
    ):
        if summary[key] is not None:
            values = (summary[key][name] for name in ("median", "mean", "p90"))
            yield what, f"{', '.join(f'{value:.3g}' for value in values)} {unit}"
    for key, what in (
        ("share_re_below_5deg", "frames with an error below 5 deg"),
        ("share_te_below_0.05", "frames with an error below 0.05 units"),
    ):
        if summary[key] is not None:
            yield what, f"{summary[key]:.1%} of {summary['frames_with_truth']}"
    if summary["out_of_view"]["frames"]:
        yield "object out of view / poses claimed there", "{frames} / {poses_ok}".format(**summary["out_of_view"])
    yield "frames a second", f"{summary['rate_hz']:.1f}"
    latency = summary["latency_ms"]
    yield "latency: p50, p90, p99", f"{', '.join(_number(latency[name]) for name in ('p50', 'p90', 'p99'))} ms"
    messages = summary["messages"]
    yield "messages recorded / lost", f"{messages['recorded']} / {messages['lost']}"
    restarts = ", ".join(f"{name} {count}x" for name, count in summary["restarts"].items())
    yield "processes restarted", restarts or "none"
    for fault in summary["faults"]:
        yield f"{fault['process']} {_FAULTS[fault['what']]}", _fault(fault)


def _fault(fault: Mapping[str, Any]) -> str:
    away = "not back" if fault["away_s"] is None else f"back after {fault['away_s']:.1f} s"
    return f"{away}, {fault['frames_without_pose']} frames without a pose"


def _stages(summary: Mapping[str, Any]) -> Table:
    table = Table(title=STAGES_TITLE, title_justify="left")
    for heading in STAGE_COLUMNS:
        table.add_column(heading, justify="left" if heading == "stage" else "right")
    for row in stage_rows(summary):
        table.add_row(*row)
    return table


def stage_rows(summary: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    """Of each stage what STAGE_COLUMNS names."""
    for name, latency in summary["latency_ms"]["by_stage"].items():
        process = summary["processes"].get(name, {})
        numbers = (*latency.values(), process.get("busy_ms_p50"), process.get("cpu_s"), process.get("rss_mb"))
        yield name, *(_number(value) for value in numbers)


def _number(value: float | None) -> str:
    return _MISSING if value is None else f"{value:.1f}"
