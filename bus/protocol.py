"""What a bus can do, whatever carries the bytes."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any, Protocol

from fieldpose.bus.topics import Address, Topic
from fieldpose.errors import FieldposeError, TransportError

SETTLE_S = 2.0
_MOST_SETTLE_S = 20.0
"""Somebody else on the bus, who does not answer, holds nobody up for longer."""

Sink = Callable[[str, bytes, int], None]
"""Takes (key, payload, time of receipt in ns); is called from the bus's own threads and returns at once."""

Watcher = Callable[[str, bool], None]
"""Takes (key, alive) of a liveliness token that appeared or disappeared."""


Answer = Callable[[bytes], bytes]
"""Takes the payload of a request and gives that of the answer, or raises what the refusal is to say; is called from
threads of the bus, several at once, and may take its time."""


@dataclass(frozen=True)
class Replies:
    """What was said to a request: the answers' payloads by the key that answered, and the refusals, a line each."""

    answers: dict[str, bytes]
    refusals: tuple[str, ...] = ()


class Closing(Protocol):
    """Something that was declared on a bus and ends with `close`."""

    def close(self) -> None: ...


class Bus(Protocol):
    """Bytes by key, and tokens that live as long as their process; a "*" in a key listens to any one part."""

    def put(self, key: str, payload: bytes, topic: Topic[Any] | None = None) -> None:
        """Send with the topic's priority, or without one ahead of every topic; nobody says whether it was received."""

    def subscribe(self, key: str, sink: Sink, capacity: int) -> Closing:
        """Give what arrives to `sink`; while that is held up, `capacity` messages wait (1: the newest)."""

    def serve(self, key: str, answer: Answer) -> Closing:
        """Answer what is asked under a key; once closed, nothing is being answered any more.

        With a "*" in it that is every key it stands for, and the answer's key is the one that was asked."""

    def ask(self, key: str, payload: bytes, timeout_s: float) -> Replies:
        """Ask all who serve the key, and wait for what they say.

        Raises TransportError where nobody has said anything within the time.
        """

    def hold(self, key: str) -> Closing:
        """Hold a liveliness token until closed, or until this process dies."""

    def live(self, key: str) -> set[str]:
        """The tokens held now by anyone."""

    def watch(self, key: str, watcher: Watcher) -> Closing:
        """Tell `watcher` of the tokens held now and of each change."""

    def settle(self, timeout_s: float, images: bool = False) -> bool:
        """Wait until messages pass between this session and all others, both ways; with `images`, also large ones.

        To be called after subscribing and before anyone is told that one is ready. False where some do not answer.
        """

    def close(self) -> None: ...


class Closer:
    """Runs its action the first time that it is closed."""

    def __init__(self, action: Callable[[], None]) -> None:
        self._action: Callable[[], None] | None = action

    def close(self) -> None:
        action, self._action = self._action, None
        if action is not None:
            action()


def refusal(key: str, error: Exception) -> str:
    """What who has asked is told, in one line."""
    text = str(error) if isinstance(error, FieldposeError) else f"failed: {type(error).__name__}: {error}"
    return f"{key}: {' '.join(text.split())}"


def nobody_answers(key: str, timeout_s: float) -> TransportError:
    """What is raised where a request is answered by nobody."""
    return TransportError(f"nobody answers at {key} after {timeout_s:g} s; is that pipeline running, and ready?")


def wait_for(bus: Bus, address: Address, stages: Iterable[str], timeout_s: float) -> None:
    """Return once each of `stages` is ready, and what is sent from here on reaches it.

    One with an OBJECT/CAMERA/ in front is of another pipeline at the same site. Raises TransportError that names those
    which are not.
    """
    wanted = {_live(address, stage): stage for stage in stages}
    changed = threading.Condition()
    alive: set[str] = set()

    def watcher(key: str, is_alive: bool) -> None:
        with changed:
            (alive.add if is_alive else alive.discard)(key)
            changed.notify()

    watching = bus.watch(replace(address, object="*", camera="*").live("*"), watcher)
    try:
        deadline = time.monotonic() + timeout_s
        with changed:
            ready = changed.wait_for(lambda: wanted.keys() <= alive, deadline - time.monotonic())
            missing = ", ".join(sorted(stage for key, stage in wanted.items() if key not in alive))
    finally:
        watching.close()
    if ready:
        if wanted:
            bus.settle(min(max(SETTLE_S, deadline - time.monotonic()), _MOST_SETTLE_S))
        return
    raise TransportError(f"not ready on the bus after {timeout_s:g} s: {missing}; is each of them running?")


def _live(address: Address, stage: str) -> str:
    *other, name = stage.split("/")
    if not other:
        return address.live(name)
    if len(other) != 2:
        raise TransportError(f"{stage!r}: expected STAGE or OBJECT/CAMERA/STAGE")
    return Address(address.site, *other).live(name)
