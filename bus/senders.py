"""Whom a receiver believes: under a name the one process that announced itself as it, and numbers that may be.

Who sends is told by the header: a name, and a number drawn when its sender began. A stage holds a token with both. Once
a writer of a topic is known by its token, nobody else is believed on that key; before, and where no stage writes it, as
where a camera of one's own sends frames, everyone is. This keeps out mistakes and strangers who know nothing of it; one
who copies what he hears on the bus is kept out by certificates and access control alone.
"""

from __future__ import annotations

import threading
import time
from typing import Any

from cachetools import LRUCache

from fieldpose.bus.messages import Header
from fieldpose.bus.protocol import Bus
from fieldpose.bus.topics import STATS, Address, Topic

KEPT = 1024
"""Senders, or keys, of which something is remembered; the longest silent is forgotten."""
_BURST, _PER_S = 10_000, 10_000.0
"""So many messages at once, and a second, one sender may have sent without a receiver having seen any."""
_CLOCK = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)
"""Goes on while this machine is suspended, as senders on others do."""


def clock_s() -> float:
    """Seconds, of a clock that nobody sets and that no suspension stops, where the system has one."""
    return time.clock_gettime(_CLOCK)


class Numbers:
    """Tells whether a sender's number can follow on the last; `now_s` is that of `clock_s`."""

    def __init__(self) -> None:
        self._last: LRUCache[tuple[str, str, int], tuple[int, float]] = LRUCache(KEPT)
        self._began_s = clock_s()

    def follows(self, key: str, header: Header, now_s: float) -> bool:
        """Whether it can, and then it is the last. Without an instance a sender may begin again, from 0."""
        sender = (key, header.source, header.instance)
        last, at_s = self._last.get(sender, (-1, self._began_s))
        step = header.sequence - last
        if header.instance == 0 and step <= 0:
            step = header.sequence + 1
        # Of one that is heard for the first time it is not known for how long it has sent.
        known = sender in self._last
        if step <= 0 or (known and step > _BURST + _PER_S * (now_s - at_s)):
            return False
        self._last[sender] = (header.sequence, now_s)
        return True


class Senders:
    """The senders of one site that have announced themselves, and who is believed on which key."""

    def __init__(self, bus: Bus, site: str) -> None:
        self._lock = threading.Lock()
        self._announced: dict[tuple[str, str, str], set[int]] = {}
        self._places: LRUCache[str, tuple[str, str] | None] = LRUCache(KEPT)
        self._bound: LRUCache[tuple[str, str], int] = LRUCache(KEPT)
        self._strict: LRUCache[str, bool] = LRUCache(KEPT)
        self._numbers = Numbers()
        self._watching = bus.watch(Address(site, "*", "*").sender("*"), self._heard)

    def doubt(self, topic: Topic[Any], key: str, header: Header) -> str | None:
        """Why a message is not believed, None where it is."""
        with self._lock:
            why = self._doubt(topic, key, header)
            if why is None and not self._numbers.follows(key, header, clock_s()):
                why = f"number {header.sequence} cannot follow on the last"
        return None if why is None else f"{topic.name}: {why}, of a sender that says it is {header.source!r}"

    def close(self) -> None:
        self._watching.close()

    def _doubt(self, topic: Topic[Any], key: str, header: Header) -> str | None:
        place = self._place(topic, key)
        if place is None:
            return "under a key that is none"
        name, instance = header.source, header.instance
        writers = (key.rpartition("/")[2],) if topic is STATS else topic.writers
        known = {writer: self._announced.get((*place, writer), set()) for writer in writers}
        if any(known.values()):
            self._strict[key] = True
        bound = self._bound.get((key, name))
        if instance in known.get(name, ()):
            if bound is not None and bound != instance and bound in known[name]:
                return "a second sender under one name"
            self._bound[key, name] = instance
            return None
        if self._strict.get(key, False) and (bound is None or bound != instance):
            return "not by who writes it here"
        return None

    def _place(self, topic: Topic[Any], key: str) -> tuple[str, str] | None:
        """Object and camera of a key; "*" where its topic is of a camera for all objects."""
        if key not in self._places:
            address = topic.address_of(key)
            object = "*" if "{object}" not in topic.template or address is None else address.object
            self._places[key] = None if address is None else (object, address.camera)
        return self._places[key]

    def _heard(self, token: str, alive: bool) -> None:
        *_, object, camera, name, number = token.split("/")
        if not number.isdecimal():
            return
        with self._lock:
            for place in ((object, camera, name), ("*", camera, name)):
                instances = self._announced.setdefault(place, set())
                (instances.add if alive else instances.discard)(int(number[:18]))
                if not instances:
                    del self._announced[place]
