"""What the benchmarks have measured, as tables for people."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rich.table import Table

from fieldpose.deploy.reporting.output import result_console


def print_render(figures: dict[str, Any]) -> None:
    """Views by size, and the limits that they are held against."""
    console = result_console()
    table = Table(title=f"a view of {figures['field']['file']}", title_justify="left")
    names = ("pixels", "ms", "twin, ms", "times faster", "loss, dB", "samples", "M samples/s", "of the limit")
    for name in names:
        table.add_column(name, justify="right")
    for size, row in figures["sizes"].items():
        table.add_row(
            size,
            f"{row['ms_per_view']:.1f}",
            f"{row['twin_ms_per_view']:.0f}",
            f"{row['speedup']:.0f}",
            f"{row['psnr_loss_db']:.2f}",
            f"{row['samples']:.0f}",
            f"{row['samples_per_s'] / 1e6:.1f}",
            f"{row['fraction_of_limit']:.0%}",
        )
    console.print(table)
    limits = figures["limits"]
    console.print(
        f"{figures['machine']}, {figures['isa']}: {2 * limits['multiply_adds_per_s'] / 1e9:.0f} GFLOP/s in small "
        "matrix products, "
        f"{limits['reads_per_s'] / 1e6:.0f} M random reads/s; highest memory of a rendering process "
        f"{figures['rss_mb']:.0f} MB",
        highlight=False,
    )
    rays, many = figures["rays"], figures["rays"]["scattered_samples_per_s"] / 1e6
    console.print(f"{rays['scattered']} scattered rays: {many:.1f} M samples/s", highlight=False)
    console.print(
        f"colours and derivatives of 512 rays, 40 times: {rays['refinement_ms']:.0f} ms; "
        f"two views: {rays['two_views_ms']:.0f} ms",
        highlight=False,
    )


def print_train(figures: dict[str, Any]) -> None:
    """Quality over time, speed and memory."""
    console = result_console()
    seconds = sorted({float(s) for scores in figures["psnr_db"].values() for s in scores})
    console.print("PSNR on held-out views (dB) after so many seconds of training:")
    console.print(_over_time(figures["psnr_db"], seconds, ".2f"))
    if figures["silhouette_coverage"]:
        console.print("share of the object's silhouette that the field shows there:")
        console.print(_over_time(figures["silhouette_coverage"], seconds, ".1%"))
    console.print(
        f"{figures['machine']}: {figures['samples_per_s'] / 1e6:.2f} M samples/s, the plain twin "
        f"{figures['twin_samples_per_s'] / 1e6:.3f} M, {figures['speedup']:.1f} times faster; highest memory "
        f"{figures['rss_mb']:.0f} MB",
        highlight=False,
    )
    for name, error in figures["depth_error"].items():
        console.print(
            f"{name}: error of depth within the object {error['median']:.2%} (median), {error['p90']:.2%} (90 %)",
            highlight=False,
        )


def _over_time(courses: dict[str, dict[str, float]], seconds: list[float], form: str) -> Table:
    table = Table()
    table.add_column("dataset")
    for second in seconds:
        table.add_column(f"{second:g}", justify="right")
    for name, values in courses.items():
        table.add_row(name, *(f"{values[f'{s:g}']:{form}}" if f"{s:g}" in values else "" for s in seconds))
    return table


def print_match(figures: dict[str, Any]) -> None:
    """A row for each size and matcher."""
    console = result_console()
    table = Table(title=f"{figures['pairs']} pairs of a view and an image of the demo scene", title_justify="left")
    for name in ("pixels", "matcher", "both new, ms", "view known, ms", "matches", "right"):
        table.add_column(name, justify="left" if name == "matcher" else "right")
    for size, rows in figures["sizes"].items():
        for name, row in rows.items():
            table.add_row(
                size,
                name,
                f"{row['ms_per_pair']:.1f}",
                f"{row['ms_view_known']:.1f}",
                f"{row['matches']:.0f}",
                f"{row['share_right']:.1%}",
            )
    console.print(table)
    console.print(
        f"{figures['machine']}, {figures['threads']} threads; right: within {figures['right_px']:g} pixels",
        highlight=False,
    )
    for name, reason in figures["missing"].items():
        console.print(f"{name} is left out: {reason}", highlight=False, markup=False)


def print_record(figures: dict[str, Any]) -> None:
    """What was lost, and what recording took."""
    rss = figures["rss_mb"]
    mb = {name: "-" if value is None else f"{value:.0f}" for name, value in rss.items()}
    result_console().print(
        f"{figures['sent']} messages in {figures['seconds']:.0f} s, {figures['mb_per_s']:.0f} MB/s,"
        f" {figures['parts']} parts: {figures['lost']} lost\n"
        f"by the senders' numbers {figures['missing_by_sequence']} are missing; {figures['unwritten']} found no room\n"
        f"{figures['cpu_share']:.2f} cores; MB of memory: {mb['before']} before, {mb['after_a_tenth']} after a tenth,"
        f" {mb['end']} in the end, {mb['highest']} at most\n"
        f"the sender was {figures['behind_s'] * 1e3:.0f} ms late at most",
        highlight=False,
    )


def print_bus(figures: dict[str, Any]) -> None:
    """Messages by size, and frames as JPEG and as pixels."""
    console = result_console()
    messages = Table(title="messages between two processes; ms at 50, 90 and 99 %", title_justify="left")
    for name in ("bytes", "one way", "there and back", "lost", "messages/s", "MB/s", "lost", "encode", "decode"):
        messages.add_column(name, justify="right")
    for size, row in figures["payloads"].items():
        messages.add_row(
            size,
            _three(row["one_way_ms"]),
            _three(row["round_trip_ms"]),
            f"{row['lost']:.1%}",
            f"{row['messages_per_s']:.0f}",
            f"{row['mb_per_s']:.0f}",
            f"{row['lost_in_flow']:.1%}",
            f"{row['encode_ms']:.3f}",
            f"{row['decode_ms']:.3f}",
        )
    console.print(messages)
    title = f"a frame to {figures['receivers']} processes; ms of CPU in all, and ms until the pixels are there"
    frames = Table(title=title, title_justify="left")
    for name in ("size", "kB", "decode once", "as JPEG", "until", "as pixels", "until", "pixels save"):
        frames.add_column(name, justify="right")
    for size, row in figures["frames"].items():
        frames.add_row(
            size,
            f"{row['jpeg_bytes'] / 1e3:.0f}",
            f"{row['decode_jpeg_ms_cpu']:.2f}",
            f"{row['jpeg_ms_cpu']:.2f}",
            f"{row['jpeg_ms_to_pixels']:.2f}",
            f"{row['rgb8_ms_cpu']:.2f}",
            f"{row['rgb8_ms_to_pixels']:.2f}",
            f"{row['jpeg_ms_cpu'] - row['rgb8_ms_cpu']:.2f}",
        )
    console.print(frames)
    console.print(f"{figures['machine']}; JPEG of quality {figures['jpeg_quality']}", highlight=False)


def print_track(figures: dict[str, Any]) -> None:
    """How each sequence was followed, by cores and by ablation; the share that is right by steps; the processes."""
    console = result_console()
    by_cores = _track_columns(figures["sequences"])
    console.print(_track_table("followed live", by_cores))
    steps = _steps(figures["sequences"])
    if steps.columns:
        console.print(steps)
    for name, measured in figures["ablations"].items():
        if measured is not figures["sequences"]:
            console.print(_track_table(name, _track_columns(measured)))
    console.print(_processes(by_cores))
    rate = figures["plain_loop_rate_hz"]
    console.print(f"{figures['machine']}; in one process, all work done: {rate:.1f} frames a second", highlight=False)


def _track_columns(measured: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {
        f"{name}, {cores} core{'' if cores == '1' else 's'}": figures
        for name, sequence in measured.items()
        for cores, figures in sequence["cores"].items()
    }


def print_start(figures: dict[str, Any]) -> None:
    """Print what `start.measure` has found."""
    table = Table("", title=f"{figures['views']} starts, {figures['machine']}", title_justify="left", show_header=False)
    table.add_column("", justify="right")
    table.add_row("first answer right", _percent(figures["share_right"]))
    table.add_row("right, and within a second", _percent(figures["share_in_time"]))
    table.add_row("answered at all", _percent(figures["share_answered"]))
    table.add_row("first pose, s: p50, p90, highest", _row(figures["first_pose_s"], ("p50", "p90", "max"), 2))
    table.add_row("ready, s", _number(figures["ready_s"], 1))
    for view in figures["not_right"]:
        errors = [_number(view[name], 3) for name in ("rotation_error_deg", "translation_error")]
        table.add_row(f"not right: {view['name']}", f"{' deg  '.join(errors)}")
    result_console().print(table)


def _track_table(title: str, columns: dict[str, dict[str, Any]]) -> Table:
    table = Table("", title=title, title_justify="left")
    for name in columns:
        table.add_column(name, justify="right")
    for what, told in _TRACK_ROWS.items():
        table.add_row(what, *(told(figures) for figures in columns.values()))
    return table


def _steps(measured: dict[str, Any]) -> Table:
    """A row for each step; no columns where there are no steps."""
    by_name = {
        name: figures["steps"]
        for name, sequence in measured.items()
        for figures in sequence["cores"].values()
        if figures.get("steps")
    }
    table = Table(title="right, of all frames sent", title_justify="left")
    for name in ("every", *by_name) if by_name else ():
        table.add_column(name, justify="right")
    for step in dict.fromkeys(step for steps in by_name.values() for step in steps):
        table.add_row(f"{step}. frame", *(_percent(steps[step]["share_right"]) for steps in by_name.values()))
    return table


def _processes(columns: dict[str, dict[str, Any]]) -> Table:
    table = Table("process", title="CPU s and memory MB (shared parts once) of each process", title_justify="left")
    for name in columns:
        table.add_column(name, justify="right")
    cpu_s, memory = "cpu_s_by_process", "pss_mb_by_process"
    names = dict.fromkeys(name for figures in columns.values() for name in (*figures[memory], *figures[cpu_s]))
    for name in names:
        table.add_row(
            name, *(f"{_number(f[cpu_s].get(name), 1)}  {_number(f[memory].get(name), 0):>5}" for f in columns.values())
        )
    return table


_ERRORS = ("median", "p99", "max")
_TRACK_ROWS: dict[str, Callable[[dict[str, Any]], str]] = {
    "frames with a pose, of those sent": lambda f: _percent(f["share_of_frames"]),
    "carried on": lambda f: f"{f['carried']}",
    "poses a second": lambda f: f"{f['poses_per_s']:.1f}",
    "capture to state, ms at 50, 90 and 99 %": lambda f: _row(f["latency_ms"], ("p50", "p90", "p99"), 0),
    "rotation error, degrees: median, 99 %, highest": lambda f: _row(f["rotation_error_deg"], _ERRORS, 3),
    "translation error: median, 99 %, highest": lambda f: _row(f["translation_error"], _ERRORS, 4),
    "jitter, degrees and units": lambda f: _row(f["jitter"], ("rotation_deg", "translation"), 4),
    "truth within 50, 90, 99 % regions": lambda f: _row(f["covariance"], ("50", "90", "99"), 2),
    "wrong while TRACKING": lambda f: f"{f['wrong_while_tracking']}",
    "states": lambda f: ", ".join(f"{state} {count}" for state, count in f["states"].items()),
    "ready, s; then first pose, s": lambda f: f"{_number(f['ready_s'], 1)}  {_number(f['first_pose_s'], 2)}",
    "memory, MB": lambda f: _number(f["pss_mb"], 0),
}


def _row(values: dict[str, float | None] | None, names: tuple[str, ...], digits: int) -> str:
    return "  ".join(_number(values[name], digits) for name in names) if values else "-"


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{share:.0%}"


def _three(percentiles: dict[str, float | None]) -> str:
    return "  ".join("-" if ms is None else f"{ms:.2f}" for ms in percentiles.values())


def print_mesh(figures: dict[str, Any]) -> None:
    """Distances and completeness of meshes, way by way."""
    table = Table(title=f"mesh of {figures['field']}, {figures['resolution']} cells", title_justify="left")
    for name in ("surface", "of", "median", "90 %", "complete", "triangles", "s"):
        table.add_column(name, justify="left" if name in ("surface", "of") else "right")
    for way, row in figures["ways"].items():
        for part in ("all", "object"):
            if (score := row.get(part)) is not None:
                errors = (f"{score[name]:.4f}" for name in ("median", "p90"))
                rest = (f"{score['complete']:.1%}", str(row["triangles"]), f"{row['seconds']:.0f}")
                table.add_row(way, part, *errors, *rest)
    result_console().print(table)


def print_chaos(figures: dict[str, Any]) -> None:
    """A row for each kind of fault, what was not as it must be, and what was left out."""
    console = result_console()
    title = f"{figures['happened']} faults, seed {figures['seed']}, {figures['frames']} frames"
    table = Table(title=title, title_justify="left")
    for name in ("fault", "events", "failed", "cause gone after, s: p50, highest", "tracks again after, s"):
        table.add_column(name, justify="left" if name == "fault" else "right")
    for kind, row in figures["kinds"].items():
        spreads = (_row(row[name], ("p50", "max"), 2) for name in ("away_s", "back_s"))
        table.add_row(kind, str(row["events"]), str(row["failed"]), *spreads)
    console.print(table)
    failures = [
        f"run {row['run']}, {row['kind']} {row['process']}: {problem}"
        for row in figures["rows"]
        for problem in row["problems"]
    ]
    left_out = [f"{kind} is left out: {why}" for kind, why in figures["skipped"].items()]
    for line in (*failures, *figures["problems"], *left_out):
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    console.print(
        f"{figures['machine']}; poses said to be tracking that were wrong: {len(figures['wrong'])}", highlight=False
    )


def print_endurance(figures: dict[str, Any]) -> None:
    """A row for each minute, and by how much memory has grown."""
    console = result_console()
    table = Table(title=f"{figures['seconds'] / 60:g} minutes at {figures['rate_hz']:g} Hz", title_justify="left")
    for name in ("minute", "frames", "answered", "sure", "wrong", "latency p50, p99, ms", "memory of all, MB"):
        table.add_column(name, justify="right")
    for number, minute in enumerate(figures["minutes"]):
        latency = minute["latency_ms"]
        counts = (str(minute[name]) for name in ("sent", "states", "sure", "wrong"))
        spread = "-" if latency is None else f"{latency['p50']:.1f}, {latency['p99']:.1f}"
        table.add_row(str(number), *counts, spread, f"{sum(minute['rss_mb'].values()):.0f}")
    console.print(table)
    if figures["growth"] is not None:
        grown = ", ".join(f"{name} {share:+.1%}" for name, share in figures["growth"].items())
        console.print(f"memory after the first minute: {grown}", highlight=False)
    console.print(f"{figures['machine']}; restarts: {figures['restarts']}", highlight=False)


def print_scale(figures: dict[str, Any]) -> None:
    """Each topic of one camera, and what many cameras take."""
    console = result_console()
    table = Table(title="one camera", title_justify="left")
    for name in ("topic", "a second", "kB/s", "readers"):
        table.add_column(name, justify="left" if name == "topic" else "right")
    for name, flow in figures["topics"].items():
        table.add_row(name, f"{flow['per_s']:.1f}", f"{flow['bytes_per_s'] / 1e3:.1f}", str(flow["readers"]))
    console.print(table)
    table = Table(title="cameras", title_justify="left")
    names = (
        "cameras", "processes", "links", "MB/s sent", "delivered", "gaps", "skipped", "age, ms: 50%", "99%",
        "behind, ms", "cores", "of the hub", "hub, MB",
    )  # fmt: skip
    for name in names:
        table.add_column(name, justify="right")
    for count, row in figures["cameras"].items():
        table.add_row(
            count, str(row["processes"]), str(row["links"]), f"{row['mb_per_s_sent']:.2f}",
            f"{row['mb_per_s_delivered']:.2f}", str(row["gaps"]), str(row["skipped"]), f"{row['age_ms']['p50']:.1f}",
            f"{row['age_ms']['p99']:.1f}", f"{row['behind_ms']:.1f}", f"{row['cpu']['all']:.2f}",
            f"{row['hub_cpu']:.3f}", f"{row['hub_rss_mb']:.0f}",
        )  # fmt: skip
    console.print(table)
    console.print(f"{figures['machine']}; load before {figures['load_before']:.1f}", highlight=False)
