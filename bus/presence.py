"""Who is on the bus, and whether messages pass: liveliness tokens carried as messages over the links themselves.

Zenoh tells of its own tokens by way of the hub too, before two peers have a link, so what is sent on seeing one can be
lost; and one in fifty that were declared while a link came up was never seen at all (1.10.2). Here each session says
which tokens it holds when that changes and when it is greeted. Whenever a link comes up or what it holds changes it
greets too, again and again for a while until it is answered, for a word may be lost. So who knows of a token knows the
subscriptions behind it. A token ends with the link to its holder: at once where that process is killed, after the lease
where its host is gone.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Annotated

import msgspec
from cachetools import LRUCache

from fieldpose.bus.protocol import SETTLE_S, Closer, Closing, Watcher
from fieldpose.bus.topics import key_matches
from fieldpose.errors import TransportError

_Key = Annotated[str, msgspec.Meta(max_length=512)]
_PAUSES_S = (0.02, 0.32)
# More than the size from which a message goes through shared memory, which takes a while to set up the first time.
_IMAGE_BYTES = 8192
MAX_BYTES = 64 << 10
_MOST_HELD = 256
_ANSWERS_PER_S = 50.0
"""To greetings under one name, which are repeated until they are answered, and under all that are kept in mind."""
_ANSWERED_KEPT = 256


class _Word(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What its sender holds; with a number and no addressee a greeting, with both an answer to one.

    changes: how often what it holds has changed, for words may overtake each other.
    """

    held: Annotated[tuple[_Key, ...], msgspec.Meta(max_length=_MOST_HELD)]
    changes: Annotated[int, msgspec.Meta(ge=0)]
    number: int = 0
    to: str = ""


class Presence:
    """The tokens held on the bus as the session `name` knows them.

    send: reaches every session that has a link; peers: the names of these.
    """

    def __init__(self, name: str, send: Callable[[bytes], None], peers: Callable[[], Iterable[str]]) -> None:
        self._name = name
        self._send = send
        self._peers = peers
        self._changed = threading.Condition(threading.RLock())
        self._mine: list[str] = []
        self._changes = 0
        self._theirs: dict[str, _Word] = {}
        self._answers: dict[str, int] = {}
        self._seen: set[str] = set()
        self._answered_s: LRUCache[str, tuple[float, float]] = LRUCache(_ANSWERED_KEPT)
        self._watchers: list[tuple[str, Watcher]] = []
        self._number = 0
        self._greet_again = self._closed = False
        self._greeter: threading.Thread | None = None

    def hold(self, key: str) -> Closing:
        with self._changed:
            self._mine.append(key)
            self._changes += 1
            self._tell()
        self._send(self._word())
        self._greet_soon()

        def release() -> None:
            with self._changed:
                self._mine.remove(key)
                self._changes += 1
                self._tell()
            with suppress(TransportError):
                self._send(self._word())
                self._greet_soon()

        return Closer(release)

    def live(self, key: str) -> set[str]:
        with self._changed:
            return {token for token in self._seen if key_matches(key, token)}

    def watch(self, key: str, watcher: Watcher) -> Closing:
        entry = (key, watcher)
        with self._changed:
            for token in sorted(self.live(key)):
                watcher(token, True)
            self._watchers.append(entry)

        def end() -> None:
            with self._changed:
                self._watchers.remove(entry)

        return Closer(end)

    def settle(self, timeout_s: float, images: bool = False) -> bool:
        """Greet until every session that has a link has answered; False where some did not in time."""
        with self._changed:
            self._number += 1
            number = self._number
        deadline, pause_s = time.monotonic() + timeout_s, _PAUSES_S[0]
        while True:
            self._send(self._word(number) + b" " * (_IMAGE_BYTES if images else 0))
            with self._changed:
                self._note_links()
                left_s = deadline - time.monotonic()
                self._changed.wait_for(lambda: self._closed or self._answered(number), pause_s)
                if self._closed or self._answered(number):
                    return not self._closed
            if left_s < 0:
                return False
            pause_s = min(2 * pause_s, _PAUSES_S[1])

    def links_changed(self) -> None:
        """Links came up or ended: learn what the new ones hold, and forget what those hold that are gone.

        Which did is asked, not told: where this process gets no time, its threads hear of two events in any order.
        """
        with self._changed:
            came, gone = self._note_links()
        if came or not gone:
            self._greet_soon()

    def heard(self, peer: str, payload: bytes) -> None:
        """Take in what another session said, and answer a greeting; what cannot be understood is passed over."""
        if peer == self._name or len(payload) > MAX_BYTES:
            return
        try:
            word = msgspec.json.decode(payload, type=_Word)
        except (msgspec.DecodeError, UnicodeDecodeError):
            return
        with self._changed:
            if peer not in self._answers:
                self._note_links()
            # Where the link is gone there is nothing to note.
            if peer in self._answers:
                if peer not in self._theirs or word.changes >= self._theirs[peer].changes:
                    self._theirs[peer] = word
                if word.to == self._name:
                    self._answers[peer] = max(self._answers[peer], word.number)
                self._tell()
                self._changed.notify_all()
        if word.number > 0 and not word.to and self._may_answer(peer):
            with suppress(TransportError):
                self._send(self._word(word.number, peer))

    def close(self) -> None:
        """Greet no more: nothing is sent once this returns, but for answers and what is let go."""
        with self._changed:
            self._closed, greeter = True, self._greeter
            self._changed.notify_all()
        if greeter is not None:
            greeter.join()

    def _note_links(self) -> tuple[set[str], set[str]]:
        """The peers that came and that are gone since the last time."""
        peers = set(self._peers())
        came, gone = peers - self._answers.keys(), self._answers.keys() - peers
        for peer in gone:
            del self._answers[peer]
            self._theirs.pop(peer, None)
        self._answers.update(dict.fromkeys(came, 0))
        if gone:
            self._tell()
            self._changed.notify_all()
        return came, gone

    def _may_answer(self, peer: str) -> bool:
        """A bucket for each name, from which an answer takes one and which time fills; and one for all names."""
        now = time.monotonic()
        with self._changed:
            for name, per_s in ((peer, _ANSWERS_PER_S), ("", 10 * _ANSWERS_PER_S)):
                left, at = self._answered_s.get(name, (per_s, now))
                left = min(per_s, left + per_s * (now - at))
                self._answered_s[name] = (left - (left >= 1), now)
                if left < 1:
                    return False
        return True

    def _answered(self, number: int) -> bool:
        return min(self._answers.values(), default=number) >= number

    def _greet_soon(self) -> None:
        """Greet in the background: a busy link may lose a word, and a greeting is repeated until it is answered."""
        with self._changed:
            if self._closed or not self._answers:
                return
            self._greet_again = True
            if self._greeter is None:
                self._greeter = threading.Thread(target=self._greet, name="greet", daemon=True)
                self._greeter.start()

    def _greet(self) -> None:
        while True:
            with self._changed:
                if self._closed or not self._greet_again:
                    self._greeter = None
                    return
                self._greet_again = False
            with suppress(TransportError):
                self.settle(SETTLE_S)

    def _word(self, number: int = 0, to: str = "") -> bytes:
        with self._changed:
            return msgspec.json.encode(_Word(tuple(self._mine), self._changes, number, to))

    def _tell(self) -> None:
        now = frozenset(self._mine).union(*(word.held for word in self._theirs.values()))
        changes = [(token, True) for token in sorted(now - self._seen)]
        changes += [(token, False) for token in sorted(self._seen - now)]
        self._seen = set(now)
        for token, alive in changes:
            for pattern, watcher in list(self._watchers):
                if key_matches(pattern, token):
                    watcher(token, alive)
