"""What can go wrong, and the dice that say what does."""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

SUPERVISOR = "supervisord"
EVENTS_A_ROUND = 6


class Kind(StrEnum):
    """kill: SIGKILL; stop: SIGSTOP for good; pause: SIGSTOP for PAUSE_S; cut: the link between two hosts is down for
    PAUSE_S; full: the disk of the recording is full; order: a run whose processes are started in another order."""

    KILL = "kill"
    STOP = "stop"
    PAUSE = "pause"
    CUT = "cut"
    FULL = "full"
    ORDER = "order"


PAUSE_S = 5.0
_SIGNALS = (Kind.KILL, Kind.STOP, Kind.PAUSE)
_SHARES = {Kind.CUT: 0.03, Kind.FULL: 0.02, Kind.ORDER: 0.05}
"""Of all events; the others are signals, each equally likely for each process."""


@dataclass(frozen=True)
class Event:
    """Something that goes wrong with a process, or with what it stands on; wait_s: since all was well again."""

    kind: Kind
    process: str = ""
    wait_s: float = 0.0

    @property
    def ends_run(self) -> bool:
        """Whether nothing can go on after it."""
        return self.kind is Kind.FULL or (self.process == SUPERVISOR and self.kind is not Kind.PAUSE)

    @property
    def title(self) -> str:
        """In words."""
        return f"{self.kind} {self.process}".strip()


@dataclass(frozen=True)
class Round:
    """Events of one run, and the order in which its processes are started."""

    events: tuple[Event, ...]
    order: tuple[str, ...]


def drawn(seed: int, count: int, processes: Sequence[str], without: Sequence[Kind] = ()) -> list[Round]:
    """So many events, in runs of at most EVENTS_A_ROUND. `without`: kinds that this machine cannot do."""
    dice = random.Random(seed)
    rounds: list[Round] = []
    events: list[Event] = []

    def close() -> None:
        if events:
            rounds.append(Round(tuple(events), tuple(dice.sample([*processes], len(processes)))))
            events.clear()

    for _ in range(count):
        event = _drawn(dice, processes, without)
        alone = event.kind in _SHARES or event.ends_run
        if alone:
            close()
        events.append(event)
        if alone or len(events) == EVENTS_A_ROUND:
            close()
    close()
    return rounds


def _drawn(dice: random.Random, processes: Sequence[str], without: Sequence[Kind]) -> Event:
    number = dice.random()
    for kind, share in _SHARES.items():
        if kind in without:
            continue
        if number < share:
            return Event(kind)
        number -= share
    return Event(dice.choice(_SIGNALS), dice.choice([*processes, SUPERVISOR]), dice.uniform(0.0, 1.0))
