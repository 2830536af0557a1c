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
        f"{figures['machine']}: {2 * limits['multiply_adds_per_s'] / 1e9:.0f} GFLOP/s in small matrix products, "
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
    table = Table()
    table.add_column("dataset")
    for second in seconds:
        table.add_column(f"{second:g}", justify="right")
    for name, scores in figures["psnr_db"].items():
        table.add_row(name, *(f"{scores[f'{s:g}']:.2f}" if f"{s:g}" in scores else "" for s in seconds))
    console.print(table)
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
    """Rates, latencies and errors of each mode, and what each process takes."""
    console = result_console()
    table = Table(title="the demo's camera, followed live at 30 frames a second", title_justify="left")
    table.add_column("mode")
    for mode in figures["modes"]:
        table.add_column(mode, justify="right")
    for what, told in _TRACK_ROWS.items():
        table.add_row(what, *(told(mode) for mode in figures["modes"].values()))
    console.print(table)
    processes = Table(title="CPU s and memory MB of each process", title_justify="left")
    processes.add_column("process")
    for mode in figures["modes"]:
        processes.add_column(mode, justify="right")
    for name in dict.fromkeys(name for mode in figures["modes"].values() for name in mode["cpu_by_process"]):
        processes.add_row(name, *(_of_process(mode, name) for mode in figures["modes"].values()))
    console.print(processes)
    console.print(figures["machine"], highlight=False)


def _of_process(mode: dict[str, Any], name: str) -> str:
    if name not in mode["cpu_by_process"]:
        return "-"
    return f"{mode['cpu_by_process'][name]:.1f}  {mode['rss_mb_by_process'][name]:5.0f}"


def _errors(mode: dict[str, Any]) -> str:
    turn, shift = mode["rotation_error_deg"], mode["translation_error"]
    return "-" if turn is None or shift is None else f"{turn['median']:.3f} deg  {shift['median']:.4f}"


_TRACK_ROWS: dict[str, Callable[[dict[str, Any]], str]] = {
    "frames sent": lambda mode: f"{mode['frames_sent']}",
    "frames with a pose, of those sent": lambda mode: _percent(mode["share_of_frames"]),
    "passes over a frame": lambda mode: "-" if mode["passes"] is None else f"{mode['passes']:.2f}",
    "frames a second": lambda mode: f"{mode['rate_hz']:.1f}",
    "in one process, one after the other": lambda mode: f"{mode['plain_loop_rate_hz']:.1f}",
    "latency, ms at 50, 90 and 99 %": lambda mode: _three({p: mode["latency_ms"][p] for p in ("p50", "p90", "p99")}),
    "of it no process's own work": lambda mode: _percent(mode["bus_share"]),
    "error, median": _errors,
    "messages lost": lambda mode: f"{mode['messages']['lost']}",
}


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{share:.0%}"


def _three(percentiles: dict[str, float | None]) -> str:
    return "  ".join("-" if ms is None else f"{ms:.2f}" for ms in percentiles.values())
