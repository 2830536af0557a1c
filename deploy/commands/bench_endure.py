"""The benchmark of a long run: options and run."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from fieldpose.deploy.benchmarks import tables
from fieldpose.deploy.reporting.output import check_writable, progress_console, write_json
from fieldpose.errors import UsageError

_FAILED = 1


@dataclass(frozen=True)
class Endure:
    """A long live run of the demo scene, there and back again: does memory grow, do latencies drift, is a pose wrong?

    Example: fieldpose bench endure --json out/bench/endure.json

    The exit code is 1 where all processes together take more than --most-growth more in the last minute than in the
    second, where a process ended, or where a pose that tracking was sure of is more than 2 degrees or 0.05 units off.
    The JSON file has: machine, seconds, rate_hz, minutes (a list: sent, states, sure, wrong, latency_ms (p50, p99),
    rss_mb (process -> median)), growth (process, and all -> share; null under three minutes), restarts, sent, wrong.
    """

    minutes: float = 30.0
    """How long."""
    rate: float = 30.0
    """Frames a second."""
    most_growth: float = 0.02
    """By which share memory may grow after the first minute."""
    json: Path | None = None

    def run(self) -> int:
        """Run, print."""
        check_writable(self.json)
        if not self.minutes > 0 or not 0 < self.rate <= 1000:
            raise UsageError("bench endure: minutes, and frames a second (at most 1000), must be above 0")
        from fieldpose.deploy.benchmarks.endurance import measure
        from fieldpose.deploy.benchmarks.sequences import LIMIT, demo

        with progress_console().status("bench endure") as status:
            followed = replace(demo(), limit=LIMIT)
            figures = measure(
                followed, 60 * self.minutes, self.rate, lambda text: status.update(f"bench endure: {text}")
            )
        write_json(self.json, figures)
        tables.print_endurance(figures)
        grown = figures["growth"] is not None and figures["growth"]["all"] > self.most_growth
        return _FAILED if grown or figures["wrong"] or figures["restarts"] else 0
