"""The processes of a running pipeline, as a table that lives."""

from __future__ import annotations

import dataclasses
import sys
import time
from dataclasses import dataclass
from typing import Annotated

import tyro
from rich.console import Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from fieldpose.bus.ports import Inbox
from fieldpose.bus.signals import StopSignals
from fieldpose.bus.topics import Address
from fieldpose.bus.transport import LOCAL_HUB, ZenohBus
from fieldpose.deploy.processes.endpoints import peer_address
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
    address: Annotated[Address, tyro.conf.arg(name="")] = dataclasses.field(
        default_factory=lambda: Address(object="*", camera="*")
    )
    """Which pipelines: a part may be "*"."""

    def run(self) -> int:
        """Show. Raises TransportError where no hub answers, and with --once where no process is heard of."""
        bus = ZenohBus(self.connect, peer_address(self.connect))
        try:
            bus.wait_for_hub(_HUB_S)
            inbox = Inbox(bus, self.address, HEARD, dict.fromkeys(HEARD, _CAPACITY))
            with StopSignals() as signals:
                if self.once or not sys.stdout.isatty():
                    self._print(inbox, signals)
                else:
                    _live(inbox, signals)
        finally:
            bus.close()
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
    """A table of each pipeline below a line of how tracking is."""
    addresses = dict.fromkeys(row.address for row in rows)
    tracking = {heading.address: heading for heading in headings}
    parts: list[Text | Table] = []
    for address in addresses:
        parts.append(_heading(address, tracking.get(address), named=len(addresses) > 1))
        parts.append(_table([row for row in rows if row.address == address]))
    return Group(*parts)


def _heading(address: Address, heading: Heading | None, named: bool) -> Text:
    text = Text(f"{address.pair}: " if named else "")
    if heading is None:
        return text.append("tracking has said nothing yet")
    state = heading.state
    text.append(str(state.state), _STATE_COLOURS[state.state])
    latency = "-" if heading.latency_ms is None else "{:.0f}, {:.0f}".format(*heading.latency_ms)
    words = [f"score {state.score:.2f}", f"{heading.rate_hz:.1f} frames/s", f"latency p50, p90: {latency} ms"]
    words.append(f"{state.dropped_at_the_door} dropped, {state.lost} lost, {state.in_flight} in flight")
    if state.level:
        words.append(f"level {state.level}")
    return text.append(f", {', '.join(words)}")


def _table(rows: list[Row]) -> Table:
    table = Table()
    for place, heading in enumerate(_COLUMNS):
        table.add_column(heading, justify="left" if place < 2 else "right", no_wrap=place < 2)
    for row in rows:
        stats = row.stats
        counts = (stats.gaps, stats.skipped, stats.refused, stats.failed, row.restarts)
        table.add_row(
            row.name, _condition(row), _number(row.published_per_s), f"{stats.busy_ms_p50:.1f}",
            f"{stats.busy_ms_p90:.1f}", _number(None if row.cpu is None else 100 * row.cpu, 0), f"{stats.rss_mb:.0f}",
            *map(str, counts), style=_COLOURS[row.condition],
        )  # fmt: skip
    return table


def _condition(row: Row) -> str:
    if row.condition == "ready":
        return ""
    return row.condition if row.condition == "ended" else f"{row.condition} {row.heard_s:.0f} s"


def _number(value: float | None, digits: int = 1) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
