"""All events of a seed, run by run, and their figures."""

from __future__ import annotations

import tempfile
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from fieldpose.deploy.benchmarks import machine
from fieldpose.deploy.benchmarks.chaos import machine_faults
from fieldpose.deploy.benchmarks.chaos.events import Kind, Round, drawn
from fieldpose.deploy.benchmarks.chaos.judging import Verdict
from fieldpose.deploy.benchmarks.chaos.rounds import Played, film, plan_of, play
from fieldpose.deploy.benchmarks.sequences import Sequence as Followed
from fieldpose.deploy.processes.programs import members

_FILM_S = 120.0
_ON_MACHINE: dict[Kind, Callable[[Path, Followed], Played]] = {
    Kind.CUT: machine_faults.cut,
    Kind.FULL: machine_faults.full,
}

Report = Callable[[str], None]


def measure(followed: Followed, seed: int, events: int, report: Report) -> dict[str, Any]:
    """Everything that `fieldpose bench chaos` prints, as its JSON; a Ctrl-C ends it with what has happened so far.

    Raises what a run raises that cannot begin.
    """
    skipped = {str(kind): why for kind, why in machine_faults.missing_rights().items()}
    all_played: list[Played] = []
    with tempfile.TemporaryDirectory(prefix="fieldpose-chaos-") as folder:
        source = film(Path(folder) / "film.mcap", followed.recording, _FILM_S)
        names = [member.name for member in members([plan_of(followed, source)], recorded=True)]
        left = deque(drawn(seed, events, names, [kind for kind in Kind if str(kind) in skipped]))
        try:
            while left:
                one = left.popleft()
                report(f"run {len(all_played) + 1}: {', '.join(event.title for event in one.events)}")
                played = _played(one, source, followed)
                all_played.append(played)
                for problem in [*(p for verdict in played.verdicts for p in verdict.problems), *played.problems]:
                    report(f"run {len(all_played)}: {problem}")
                if played.left and played.verdicts:
                    left.appendleft(replace(one, events=tuple(played.left)))
        except KeyboardInterrupt:
            report("ended early")
    return {"machine": machine.describe(), "seed": seed, "events": events, **figures_of(all_played), "skipped": skipped}


def figures_of(runs: Sequence[Played]) -> dict[str, Any]:
    """The figures of these runs, under the keys that the package's description lists."""
    verdicts = [(number, verdict) for number, run in enumerate(runs, 1) for verdict in run.verdicts]
    kinds: dict[str, list[Verdict]] = {}
    for _, verdict in verdicts:
        kinds.setdefault(verdict.event.title, []).append(verdict)
    return {
        "happened": len(verdicts),
        "failed": sum(bool(verdict.problems) for _, verdict in verdicts),
        "rows": [{"run": number, **verdict.row} for number, verdict in verdicts],
        "kinds": {title: _of_kind(those) for title, those in sorted(kinds.items())},
        "wrong": [{"run": number, **asdict(one)} for number, run in enumerate(runs, 1) for one in run.wrong],
        "frames": sum(run.frames for run in runs),
        "problems": [f"run {number}: {problem}" for number, run in enumerate(runs, 1) for problem in run.problems],
    }


def _played(one: Round, source: Path, followed: Followed) -> Played:
    does = _ON_MACHINE.get(one.events[0].kind)
    return play(one, source, followed) if does is None else does(source, followed)


def _of_kind(verdicts: Sequence[Verdict]) -> dict[str, Any]:
    return {
        "events": len(verdicts),
        "failed": sum(bool(verdict.problems) for verdict in verdicts),
        "away_s": _spread([verdict.away_s for verdict in verdicts]),
        "back_s": _spread([verdict.back_s for verdict in verdicts]),
    }


def _spread(values: Sequence[float | None]) -> dict[str, float] | None:
    known = [value for value in values if value is not None]
    return {"p50": float(np.median(known)), "max": max(known)} if known else None
