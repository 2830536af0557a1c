"""The benchmark of faults: options and run."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from fieldpose.deploy.benchmarks import tables
from fieldpose.deploy.reporting.output import check_writable, progress_console, write_json
from fieldpose.errors import UsageError

_FAILED = 1


@dataclass(frozen=True)
class Chaos:
    """Faults at random, one after another, in live runs of the demo scene.

    Example: fieldpose bench chaos --json out/bench/chaos.json

    Processes are killed, stopped for good and stopped for five seconds, hub, recorder and supervisord among them; the
    link between two hosts is cut, the disk of a recording is full, processes are started in another order. After each
    it must track again within 2 s of the cause being gone, the fault must be told, and no pose that is said to be
    tracking may be wrong; no process, shared memory, folder or unfinished recording may be left. The exit code is 1
    where something is not so. What this machine has no right to do is left out and named. The keys of the JSON file
    stand in deploy/benchmarks/chaos/__init__.py.
    """

    events: int = 200
    """How many; about ten seconds each. A Ctrl-C ends it with what has happened so far."""
    seed: int = 0
    """Of the dice: the same events again."""
    json: Path | None = None

    def run(self) -> int:
        """Bring the events about, judge, print."""
        check_writable(self.json)
        from fieldpose.deploy.benchmarks.chaos.measure import measure
        from fieldpose.deploy.benchmarks.sequences import LIMIT, demo

        if self.events < 1:
            raise UsageError(f"bench chaos: at least one event is needed, got {self.events}")
        console = progress_console()
        report = lambda text: console.print(f"bench chaos: {text}", highlight=False, soft_wrap=True)  # noqa: E731
        # The demo's own limit is what it keeps in nearly all frames, with or without faults.
        followed = replace(demo(), limit=LIMIT)
        figures = measure(followed, self.seed, self.events, report)
        write_json(self.json, figures)
        tables.print_chaos(figures)
        as_it_must = not (figures["failed"] or figures["problems"] or figures["wrong"])
        return 0 if as_it_must and figures["happened"] >= self.events else _FAILED
