"""Whether fieldpose can work here."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from rich.console import Console

from fieldpose.deploy import checks
from fieldpose.deploy.access.checks import closed, listening
from fieldpose.deploy.checks import Check, Finding
from fieldpose.deploy.reporting.output import progress_console, result_console, write_json

_COLOURS = {"ok": "green", "note": "cyan", "warning": "yellow", "failed": "red"}


@dataclass(frozen=True)
class Options:
    """Check this machine, the bus, the weights of the matchers and, where given, a field and a dataset.

    Example: fieldpose doctor --dataset ../shared/data/lego

    Exits with 1 where something keeps fieldpose from working. The JSON file is a list of: what, status (ok, note,
    warning or failed), detail, mend.
    """

    field: Path | None = None
    """A field to check."""
    dataset: Path | None = None
    """A dataset to check: every image of it, and whether its cameras fit what the images show, which takes a minute."""
    json: Path | None = None
    """Write the findings into this file."""

    def run(self) -> int:
        """Check, print each finding as it comes."""
        console = result_console()
        findings = []
        with progress_console().status("checking"):
            for finding in self._findings():
                findings.append(finding)
                _print(finding, console)
        write_json(self.json, [asdict(finding) for finding in findings])
        return int(any(finding.status == "failed" for finding in findings))

    def _findings(self) -> Iterator[Finding]:
        for check in self._checks():
            yield from check()

    def _checks(self) -> Iterator[Check]:
        yield from (checks.machine, checks.packages, checks.bus, listening, closed, checks.backend, checks.kernels)
        yield from (checks.weights, checks.demo_scene)
        if self.field is not None:
            yield partial(checks.field, self.field)
        if self.dataset is not None:
            # It brings what structure is found by, which takes a second.
            from fieldpose.deploy.dataset_checks import dataset

            yield partial(dataset, self.dataset)


def _print(finding: Finding, console: Console) -> None:
    colour = _COLOURS[finding.status]
    console.print(f"[{colour}]{finding.status:8}[/]", f"{finding.what}: ", end="", highlight=False)
    text = f"{finding.detail}: {finding.mend}" if finding.mend else finding.detail
    console.print(text, markup=False, highlight=False, soft_wrap=True)
