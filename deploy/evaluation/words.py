"""The scores of an evaluation in words: lines about it, a table of its methods, and how these differ."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from rich.table import Table

from fieldpose.deploy.reporting.output import result_console

COLUMNS = (
    "method", "pairs", "< 5 deg", "< 0.05", "ok", "right of ok", "RE mean", "median", "TE mean", "median", "s",
)  # fmt: skip


def print_scores(figures: dict[str, Any]) -> None:
    """Print the scores on stdout."""
    console = result_console()
    for line in about(figures):
        console.print(line, highlight=False)
    console.print(_table(figures["methods"]))
    for line in gaps(figures):
        console.print(line, highlight=False)


def about(figures: dict[str, Any]) -> list[str]:
    """What was evaluated, and how."""
    protocol = figures["protocol"]
    least, most = protocol["angle_deg"]
    lines = [f"interrupted: {_done(figures)}"] if figures["interrupted"] else []
    lines += [
        f"{figures['pairs']} pairs (seeds {in_short(figures['seeds'])}), lengths in: {figures['unit']}",
        f"{protocol['name']}: guesses turned by {least:g} to {most:g} degrees about the {protocol['turn_about']}"
        f" {'or' if protocol['in_turn'] else 'and'} shifted by up to {protocol['max_translation']:.3g}",
    ]
    if figures["covered"] is not None:
        lines.append(f"{figures['covered']:.0%} of the images are covered")
    return lines


def _done(figures: dict[str, Any]) -> str:
    return ", ".join(f"{name} has answered {row['pairs']}" for name, row in figures["methods"].items())


def gaps(figures: dict[str, Any]) -> list[str]:
    """By how much the errors of methods differ."""
    lines = []
    for name, gap in figures["differences"].items():
        plain = f"RE {_gap(gap['re_deg'])}, TE {_gap(gap['te'])}"
        capped = f"capped: RE {_gap(gap['capped_re_deg'])}, TE {_gap(gap['capped_te'])}"
        lines.append(f"{name} against {gap['than']}: {plain}; {capped}")
    return lines


def in_short(numbers: Sequence[int]) -> str:
    """Numbers from the least to the greatest, where they are all of these."""
    low, high = min(numbers), max(numbers)
    if high > low + 1 and list(numbers) == list(range(low, high + 1)):
        return f"{low} to {high}"
    return ", ".join(map(str, numbers))


def _table(methods: dict[str, Any]) -> Table:
    table = Table()
    for column in COLUMNS:
        table.add_column(column, justify="left" if column == "method" else "right")
    for row in rows(methods):
        table.add_row(*row)
    return table


def rows(methods: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    """Of each method what COLUMNS names."""
    for name, row in methods.items():
        shares = ("share_re_below_5deg", "share_te_below_0.05", "share_ok", "share_ok_right")
        errors = (("mean_re_deg", 3), ("median_re_deg", 3), ("mean_te", 5), ("median_te", 5))
        yield (
            name,
            str(row["pairs"]),
            *(_number(row[share], 3) for share in shares),
            *(_number(row[error], digits) for error, digits in errors),
            f"{row['seconds_per_image']:.2f}",
        )


def _gap(gap: dict[str, float] | None) -> str:
    return "-" if gap is None else f"{gap['mean']:+.3g} ({gap['low']:+.3g} to {gap['high']:+.3g})"


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
