"""Bad bytes into everything that reads bytes from outside."""

from __future__ import annotations

import fnmatch
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
from rich.table import Table

from fieldpose.deploy.reporting.output import check_writable, progress_console, result_console, write_json
from fieldpose.errors import UsageError

if TYPE_CHECKING:
    from fieldpose.deploy.fuzzing.campaign import Finding, Result


@dataclass(frozen=True)
class Fuzz:
    """Random and mutated inputs for every reader: messages, recordings, fields, datasets, calibrations, images, ROS.

    Example: fieldpose bench fuzz --targets 'dataset/*' --inputs 100000

    Inputs that reach new lines of our code are changed further. Found is whatever is neither read nor refused by the
    reader's own error in one line: other errors, hangs, crashes, and memory beyond the bound; it ends with exit code 1
    then. Each finding is kept in a file of its own, for --replay. The JSON file has: bounds, targets (name -> inputs,
    refused, ways, seconds, findings (kind -> detail)).
    """

    targets: tuple[str, ...] = ("*",)
    """Names or patterns of what to try; --inputs 0 lists all."""
    inputs: int = 1_000_000
    """Over all targets."""
    seconds: float = 3600.0
    """Over all targets; what comes first ends it."""
    hang_s: float = 10.0
    """CPU time in which an input must be read or refused."""
    memory_mb: int = 2048
    """What reading an input may take."""
    seed: int = 0
    out: Path = Path("out/fuzz")
    """Folder of the findings."""
    replay: tuple[Path, ...] = ()
    """Read these findings once more instead."""
    json: Path | None = None

    def run(self) -> int:
        """Try, print, keep; 1 where something was found."""
        check_writable(self.json)
        if self.inputs < 0 or not (self.seconds > 0 and self.hang_s > 0 and self.memory_mb > 0):
            raise UsageError("bench fuzz: inputs, seconds, hang-s and memory-mb must be above 0")
        from fieldpose.deploy.fuzzing.campaign import Bounds, run_campaign
        from fieldpose.deploy.fuzzing.targets import targets

        every, bounds = targets(), Bounds(self.hang_s, self.memory_mb)
        if self.replay:
            return self._replay(bounds)
        chosen = [name for name in every if any(fnmatch.fnmatch(name, wanted) for wanted in self.targets)]
        if not chosen or self.inputs == 0:
            raise UsageError(f"bench fuzz: choose targets of {', '.join(every)}")
        results: list[Result] = []
        with progress_console().status("bench fuzz") as status:
            for name in chosen:
                status.update(f"bench fuzz: {name}")
                inputs, seconds = max(1, self.inputs // len(chosen)), self.seconds / len(chosen)
                results.append(run_campaign(every[name], inputs, seconds, bounds, self.seed))
        found = [finding for result in results for kept in result.findings.values() for finding in kept]
        self._keep(found)
        write_json(self.json, {"bounds": msgspec.to_builtins(bounds), "targets": _figures(results)})
        result_console().print(_table(results))
        for finding in found:
            print(f"{finding.target}: {finding.kind}: {finding.detail}")
        return 1 if found else 0

    def _keep(self, found: list[Finding]) -> None:
        for number, finding in enumerate(found):
            self.out.mkdir(parents=True, exist_ok=True)
            path = self.out / f"{finding.target.replace('/', '-')}-{number}.fuzz"
            path.write_bytes(msgspec.msgpack.encode(finding))

    def _replay(self, bounds: object) -> int:
        from fieldpose.deploy.fuzzing.campaign import Bounds, Finding, replayed
        from fieldpose.deploy.fuzzing.targets import targets

        assert isinstance(bounds, Bounds)
        every, wrong = targets(), 0
        for path in self.replay:
            try:
                finding = msgspec.msgpack.decode(path.read_bytes(), type=Finding)
            except (OSError, msgspec.DecodeError) as error:
                raise UsageError(f"{path}: no finding of `fieldpose bench fuzz` ({error})") from error
            if finding.target not in every:
                raise UsageError(f"{path}: is of {finding.target}, which is none of {', '.join(every)}")
            kind, said = replayed(every[finding.target], finding, bounds)
            wrong += kind is not None
            print(f"{path}: {finding.target}: {kind or 'well'}: {said}")
        return 1 if wrong else 0


def _figures(results: list[Result]) -> dict[str, object]:
    return {
        result.target: {
            "inputs": result.inputs, "refused": result.refused, "ways": result.ways,
            "seconds": round(result.seconds, 1),
            "findings": {kind: kept[0].detail for kind, kept in result.findings.items()},
        }
        for result in results
    }  # fmt: skip


def _table(results: list[Result]) -> Table:
    table = Table("reader", "inputs", "refused", "ways through our lines", "s", "kinds found")
    for result in results:
        row = (result.inputs, result.refused, result.ways, f"{result.seconds:.0f}", len(result.findings))
        table.add_row(result.target, *map(str, row))
    total = (
        sum(r.inputs for r in results),
        sum(r.refused for r in results),
        "",
        f"{sum(r.seconds for r in results):.0f}",
    )
    table.add_row("all", *map(str, total), str(sum(len(r.findings) for r in results)))
    return table
