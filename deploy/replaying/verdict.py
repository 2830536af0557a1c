"""Whether a replay came out as it was recorded: what is asked of it, and the answer in figures and words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

from rich.table import Table

from fieldpose.bus.topics import ESTIMATE, POSE, STATE
from fieldpose.deploy.replaying.comparison import TopicComparison
from fieldpose.errors import ConfigError

Check = Literal["exact", "close"]
_RESULTS = (STATE.name, POSE.name, ESTIMATE.name)
"""Topics of which poses are compared, the last in the dataflow first."""


@dataclass(frozen=True)
class Closeness:
    """When a replay is close enough, by the poses that it ends with.

    On another processor networks and solvers round otherwise, so that matches differ, and poses by far less than their
    error. A recording made live had other moments to solve at than its replay.
    """

    within_deg: float = 0.2
    """Two poses of a frame are close that are turned by no more than so many degrees,"""
    within: float = 0.01
    """and shifted by no more than this share of the camera's median distance from the field's origin;"""
    share: float = 1.0
    """and so large a share of the recorded ones has to be found again."""

    def __post_init__(self) -> None:
        if self.within_deg < 0 or self.within < 0 or not 0 < self.share <= 1:
            raise ConfigError(
                f"within_deg {self.within_deg:g}, within {self.within:g}, share {self.share:g}: expected limits of at"
                " least 0 and a share above 0 and up to 1"
            )


@dataclass(frozen=True)
class Verdict:
    """fed: messages to be answered; answered: those that were; topics: how what was said compares, by topic."""

    fed: int
    answered: int
    topics: Mapping[str, TopicComparison]

    def complaints(self, check: Check, closeness: Closeness) -> list[str]:
        """What is not as it is to be, a line each; none where all is well."""
        lines = [] if self.fed == self.answered else [f"{self.fed - self.answered} of {self.fed} were not answered"]
        if check == "exact":
            return lines + [f"{name}: {_differing(of)}" for name, of in self.topics.items() if not of.identical]
        name = next((name for name in _RESULTS if name in self.topics), None)
        if name is None or not self.topics[name].both:
            return [*lines, "nothing with poses was recorded and said again, so that none can be close"]
        if not self.topics[name].poses and self.topics[name].new:
            return [*lines, f"{name}: {self.topics[name].new} poses are said now, and none was recorded"]
        share = self.topics[name].share_within(closeness.within_deg, closeness.within)
        if share < closeness.share:
            lines.append(
                f"{name}: {share:.1%} of the recorded poses are found again within {closeness.within_deg:g} degrees and"
                f" {closeness.within:.2%} of the distance, expected {closeness.share:.1%}"
            )
        return lines

    def table(self) -> Table:
        """For people."""
        table = Table(title="what was recorded, and what is said now", title_justify="left")
        for column in ("topic", "in both", "the same", "recorded only", "now only"):
            table.add_column(column, justify="left" if column == "topic" else "right")
        table.add_column("fields that differ (messages, at most)")
        for name, of in self.topics.items():
            counts = (of.both, of.same, of.only_recorded, of.only_replayed)
            table.add_row(name, *map(str, counts), _fields(of))
        return table

    def figures(self) -> dict[str, Any]:
        """As JSON has it."""
        topics = {}
        for name, of in self.topics.items():
            figures = asdict(of)
            del figures["distance"]
            for key in ("rotation_deg", "translation"):
                figures[key] = max(figures[key], default=None)
            topics[name] = figures
        return {"fed": self.fed, "answered": self.answered, "topics": topics}


def _differing(of: TopicComparison) -> str:
    counts = [
        (of.both - of.same, f"of {of.both} differ in {_fields(of)}"),
        (of.only_recorded, "are in the recording alone"),
        (of.only_replayed, "are said now alone"),
    ]
    return ", ".join(f"{count} {words}" for count, words in counts if count)


def _fields(of: TopicComparison) -> str:
    named = (
        f"{name} ({found.messages}" + ("" if found.largest is None else f", {found.largest:.3g}") + ")"
        for name, found in of.fields.items()
    )
    return ", ".join(named)
