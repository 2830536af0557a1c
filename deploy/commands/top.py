"""The processes of a running pipeline, as a table that lives."""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated

import tyro
from rich.console import Console, ConsoleOptions, Group, RenderResult
from rich.live import Live
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from fieldpose.bus.messages import State
from fieldpose.bus.ports import Inbox
from fieldpose.bus.signals import StopSignals
from fieldpose.bus.topics import Address
from fieldpose.bus.transport import LOCAL_HUB
from fieldpose.deploy.access.joining import Entry, joined
from fieldpose.deploy.access.roles import VIEWER
from fieldpose.deploy.reporting.output import result_console
from fieldpose.deploy.viewing.standing import HEARD, Heading, Row, Standing
from fieldpose.errors import TransportError

_HUB_S = 5.0
_PERIOD_S = 0.5
_ONCE_S, _AT_MOST_S = 1.0, 3.0
_CAPACITY = 4096
_COLUMNS = (
    "process", "", "msgs/s", "busy ms p50", "p90", "CPU %", "MB", "gaps", "skipped", "refused", "failed", "restarts",
)  # fmt: skip
_TRACKING = "tracking"
_NARROW = {"busy ms p50": "p50 ms", "skipped": "skip", "restarts": "restart"}
"""Headings where there is little room."""
_LEFT_OUT_FIRST = ("p90", "skipped", "MB")
_ANY_WIDTH = 10_000
_GONE_COLOURS = {"silent": "red", "ended": "dim"}
_COLOURS = {"starting": "yellow", "ready": "", "ended": "dim", "silent": "red"}
_STATE_COLOURS = {"tracking": "green", "limited": "yellow", "lost": "red", "initializing": "yellow"}


@dataclass(frozen=True)
class Options:
    """Show what the processes of a running pipeline do, from any machine that reaches its hub, until Ctrl-C.

    Example: fieldpose top --connect tcp/127.0.0.1:7447

    Of each process: messages sent a second, how long a call takes, CPU (100 % is a whole core), memory, what its inputs
    missed (gaps) or let go on purpose (skipped), payloads that were no message, calls that failed, and restarts that
    were seen. One that was not heard of for 3 s is red. A process that serves several pipelines has a row in each.
    """

    connect: str = LOCAL_HUB
    """Where the hub is; `fieldpose run` says it when it starts."""
    once: bool = False
    """Print one table after a second, and end; so it is too where stdout is no terminal."""
    entry: Annotated[Entry, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Entry)
    address: Annotated[Address, tyro.conf.arg(name="")] = dataclasses.field(
        default_factory=lambda: Address(object="*", camera="*")
    )
    """Which pipelines: a part may be "*"."""

    def run(self) -> int:
        """Show. Raises TransportError where no hub answers, and with --once where no process is heard of."""
        with joined(self.connect, self.entry, (VIEWER,), _HUB_S) as bus, StopSignals() as signals:
            inbox = Inbox(bus, self.address, HEARD, dict.fromkeys(HEARD, _CAPACITY))
            if self.once or not sys.stdout.isatty():
                self._print(inbox, signals)
            else:
                _live(inbox, signals)
        return 0

    def _print(self, inbox: Inbox, signals: StopSignals) -> None:
        standing, began = Standing(time.time_ns()), time.monotonic()
        while not signals.stop.wait(0.05):
            standing.note(inbox.drain())
            rows, seconds = standing.rows(time.time_ns()), time.monotonic() - began
            # Under load a second may be too short for the two that a rate is made of.
            settled = rows and all(row.cpu is not None or row.condition != "ready" for row in rows)
            if seconds > (_ONCE_S if settled else _AT_MOST_S):
                break
        now_ns = time.time_ns()
        if not standing.rows(now_ns):
            address = self.address
            raise TransportError(f"no process of {address.site}/{address.pair} is heard of at {self.connect}")
        result_console().print(shown(standing.rows(now_ns), standing.headings(now_ns)))


def _live(inbox: Inbox, signals: StopSignals) -> None:
    standing = Standing(time.time_ns())
    with Live(Text("no process is heard of yet"), console=result_console(), auto_refresh=False) as live:
        while not signals.stop.wait(_PERIOD_S):
            standing.note(inbox.drain())
            now_ns = time.time_ns()
            rows = standing.rows(now_ns)
            if rows:
                live.update(shown(rows, standing.headings(now_ns)), refresh=True)


def shown(rows: list[Row], headings: list[Heading]) -> Group:
    """A table of each pipeline below a line of how tracking is; tables fit the width of what they are printed on."""
    addresses = dict.fromkeys(row.address for row in rows)
    tracking = {heading.address: heading for heading in headings}
    parts: list[Text | _Processes] = []
    for address in addresses:
        own = [row for row in rows if row.address == address]
        parts.append(_heading(address, tracking.get(address), own, named=len(addresses) > 1))
        parts.append(_Processes(own))
    return Group(*parts)


def _heading(address: Address, heading: Heading | None, rows: list[Row], named: bool) -> Text:
    text = Text(f"{address.pair}: " if named else "")
    if heading is None:
        return text.append("tracking has said nothing yet")
    state = heading.state
    gone = next((row for row in rows if row.name == _TRACKING and row.condition in ("silent", "ended")), None)
    if gone is not None:
        how = "has ended" if gone.condition == "ended" else f"is {_condition(gone)}"
        text.append(f"tracking {how}, what it said last: ", _GONE_COLOURS[gone.condition])
        return text.append(f"{state.state}, score {state.score:.2f}, {_doorkeeping(state)}", "dim")
    text.append(str(state.state), _STATE_COLOURS[state.state])
    latency = "-" if heading.latency_ms is None else "{:.0f}, {:.0f}".format(*heading.latency_ms)
    words = [f"score {state.score:.2f}", f"{heading.rate_hz:.1f} frames/s", f"latency p50, p90: {latency} ms"]
    words.append(_doorkeeping(state))
    if state.level:
        words.append(f"level {state.level}")
    return text.append(f", {', '.join(words)}")


def _doorkeeping(state: State) -> str:
    return f"{state.dropped_at_the_door} dropped, {state.lost} lost, {state.in_flight} in flight"


@dataclass(frozen=True)
class _Processes:
    """A pipeline's processes: as a table with lines, or where that is too wide as one without, and with less in it."""

    rows: list[Row]

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        table = _table(self.rows, narrow=False)
        unbounded = options.update(width=_ANY_WIDTH)
        for left_out in range(len(_LEFT_OUT_FIRST) + 1):
            if Measurement.get(console, unbounded, table).maximum <= options.max_width:
                break
            table = _table(self.rows, narrow=True, without=_LEFT_OUT_FIRST[:left_out])
        yield table


def _table(rows: list[Row], narrow: bool, without: Sequence[str] = ()) -> Table:
    table = Table(box=None, padding=(0, 1, 0, 0)) if narrow else Table()
    kept = [place for place, heading in enumerate(_COLUMNS) if heading not in without]
    for place in kept:
        heading = _NARROW.get(_COLUMNS[place], _COLUMNS[place]) if narrow else _COLUMNS[place]
        table.add_column(heading, justify="left" if place < 2 else "right", no_wrap=True)
    for row in rows:
        cells = _cells(row, _in_short if narrow else str)
        table.add_row(*(cells[place] for place in kept), style=_COLOURS[row.condition])
    return table


def _cells(row: Row, written: Callable[[int], str]) -> list[str]:
    stats = row.stats
    counts = (stats.gaps, stats.skipped, stats.refused, stats.failed, row.restarts)
    return [
        row.name, _condition(row), _number(row.published_per_s), _number(stats.busy_ms_p50),
        _number(stats.busy_ms_p90), _number(None if row.cpu is None else 100 * row.cpu, 0), f"{stats.rss_mb:.0f}",
        *map(written, counts),
    ]  # fmt: skip


def _in_short(count: int) -> str:
    """A count in at most four characters up to a thousand million: 12345 is 12k."""
    for unit in ("", "k", "M"):
        if count < (10_000 if not unit else 1000):
            return f"{count}{unit}"
        count //= 1000
    return f"{count}G"


def _condition(row: Row) -> str:
    if row.condition == "ready":
        return ""
    return row.condition if row.condition == "ended" else f"{row.condition} {row.heard_s:.0f} s"


def _number(value: float | None, digits: int = 1) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
