"""Tokens as messages: known to whoever has a link, whatever the order of events; gone with the link."""

from __future__ import annotations

import threading
import time

import pytest

from fieldpose.bus.presence import MAX_BYTES, Presence


class Links:
    """Sessions and the links between them; what is sent before a link is up is lost without a word."""

    def __init__(self) -> None:
        self.sessions: dict[str, Presence] = {}
        self.up: set[frozenset[str]] = set()
        self.lossy = 0

    def open(self, name: str) -> Presence:
        self.sessions[name] = Presence(name, lambda word: self._send(name, word), lambda: self.of(name))
        return self.sessions[name]

    def of(self, name: str) -> set[str]:
        return {other for link in self.up for other in link if name in link and other != name}

    def link(self, a: str, b: str) -> None:
        self.up.add(frozenset((a, b)))
        self._tell(a, b)

    def cut(self, a: str, b: str) -> None:
        self.up.discard(frozenset((a, b)))
        self._tell(a, b)

    def _tell(self, *names: str) -> None:
        for name in names:
            if name in self.sessions:
                self.sessions[name].links_changed()

    def _send(self, sender: str, word: bytes) -> None:
        for name, session in list(self.sessions.items()):
            if frozenset((sender, name)) in self.up:
                if self.lossy > 0:
                    self.lossy -= 1
                    continue
                session.heard(sender, word)


@pytest.fixture
def links() -> Links:
    return Links()


def soon(presence: Presence, expected: set[str]) -> None:
    deadline = time.monotonic() + 30.0
    while presence.live("live/*") != expected and time.monotonic() < deadline:
        time.sleep(0.002)
    assert presence.live("live/*") == expected


@pytest.mark.parametrize("early", [True, False])
def test_a_token_is_known_whether_it_was_held_before_or_after_the_link(links: Links, early: bool) -> None:
    a, b = links.open("a"), links.open("b")
    if early:
        b.hold("live/pnp")
    links.link("a", "b")
    if not early:
        b.hold("live/pnp")
    soon(a, {"live/pnp"})


def test_a_greeting_that_is_lost_is_repeated(links: Links) -> None:
    a, b = links.open("a"), links.open("b")
    b.hold("live/pnp")
    links.lossy = 5
    links.link("a", "b")
    soon(a, {"live/pnp"})


def test_what_is_held_or_let_go_is_said_again_where_the_word_was_lost(links: Links) -> None:
    a, b = links.open("a"), links.open("b")
    links.link("a", "b")
    assert b.settle(2.0)
    links.lossy = 1
    held = b.hold("live/pnp")
    soon(a, {"live/pnp"})
    links.lossy = 1
    held.close()
    soon(a, set())


def test_a_word_that_was_overtaken_by_a_newer_one_changes_nothing(links: Links) -> None:
    """An answer that was put into words before a token was held, and sent after that was told."""
    a, b = links.open("a"), links.open("b")
    links.link("a", "b")
    changes: list[bool] = []
    a.watch("live/*", lambda key, alive: changes.append(alive))
    held = b.hold("live/pnp")
    soon(a, {"live/pnp"})
    a.heard("b", b'{"held":[],"changes":0,"number":1,"to":"a"}')
    assert a.live("live/*") == {"live/pnp"}
    held.close()
    soon(a, set())
    a.heard("b", b'{"held":["live/pnp"],"changes":1}')
    assert changes == [True, False]


def test_a_lost_link_takes_its_tokens_along_and_a_late_word_does_not_bring_them_back(links: Links) -> None:
    a, b = links.open("a"), links.open("b")
    links.link("a", "b")
    b.hold("live/pnp")
    soon(a, {"live/pnp"})
    links.cut("a", "b")
    assert a.live("live/*") == set()
    a.heard("b", b'{"held":["live/pnp"],"changes":9}')
    assert a.live("live/*") == set()
    links.link("a", "b")
    soon(a, {"live/pnp"})


def test_two_holders_of_one_token_count_as_one_until_both_are_gone(links: Links) -> None:
    a, b, c = links.open("a"), links.open("b"), links.open("c")
    changes: list[bool] = []
    a.watch("live/*", lambda key, alive: changes.append(alive))
    links.link("a", "b")
    links.link("a", "c")
    first, _ = b.hold("live/pnp"), c.hold("live/pnp")
    soon(a, {"live/pnp"})
    first.close()
    assert a.live("live/*") == {"live/pnp"}
    links.cut("a", "c")
    assert changes == [True, False]


def test_links_are_known_whatever_was_told_of_them_and_when(links: Links) -> None:
    """Of a link that came, ended and came again the end may be told last, or nothing at all."""
    a, b = links.open("a"), links.open("b")
    held = b.hold("live/pnp")
    links.link("a", "b")
    soon(a, {"live/pnp"})
    a.links_changed()
    assert a.live("live/*") == {"live/pnp"}
    links.up.clear()
    assert a.settle(0.1)
    assert a.live("live/*") == set()
    links.up.add(frozenset("ab"))
    held.close()
    b.hold("live/lifting")
    assert a.live("live/*") == {"live/lifting"}


def test_settling_waits_for_every_link_and_says_when_one_does_not_answer(links: Links) -> None:
    a, _ = links.open("a"), links.open("b")
    assert a.settle(0.1)
    links.link("a", "b")
    assert a.settle(1.0)
    links.link("a", "mute")
    assert not a.settle(0.1)
    threading.Timer(0.05, links.cut, ("a", "mute")).start()
    assert a.settle(30.0)


def test_nobody_is_greeted_once_it_is_closed(links: Links) -> None:
    a = links.open("a")
    links.link("a", "mute")
    a.close()
    assert not any(thread.name == "greet" and thread.is_alive() for thread in threading.enumerate())
    links.link("a", "another")
    began = time.monotonic()
    assert not a.settle(600.0)
    assert time.monotonic() - began < 300.0
    assert not any(thread.name == "greet" and thread.is_alive() for thread in threading.enumerate())


NO_WORDS = [
    b"",
    b"\xff\xfe",
    b"[]",
    b'{"held":[]}',
    b'{"held":[],"changes":-1}',
    b'{"held":3,"changes":9}',
    b'{"held":[3],"changes":9}',
    b'{"held":[],"changes":9,"surprise":1}',
    b'{"held":["x"],"changes":9,"number":{}}',
    b'{"held":["' + b"k" * 513 + b'"],"changes":9}',
    b'{"held":["live/x"],"changes":9}' + b" " * MAX_BYTES,
    b"[" * 5000,
]


@pytest.mark.parametrize("word", NO_WORDS)
def test_what_is_no_word_is_passed_over(links: Links, word: bytes) -> None:
    a, b = links.open("a"), links.open("b")
    links.link("a", "b")
    b.hold("live/pnp")
    soon(a, {"live/pnp"})
    a.heard("b", word)
    assert a.live("live/*") == {"live/pnp"}
