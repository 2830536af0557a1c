"""Zenoh's log, the only place that tells why a connection was refused: on stderr, refusals in one clear line each."""

from __future__ import annotations

import atexit
import os
import re
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress

import zenoh
from cachetools import LRUCache

from fieldpose.bus.protocol import Closer, Closing

_LINKS, _ROLES = "zenoh_link_tls::unicast=warn", "zenoh::net::routing::interceptor=trace"
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")
_LINK = re.compile(r"WARN .*zenoh_link_tls::unicast: (.*)")
_THREAD = re.compile(r"(ThreadId\(\d+\))")
_ROLE = re.compile(
    r"interceptor::access_control: (?:Using cached result: )?(\w+)"
    r"(?: on \S*CertCommonName\(([^)]*)\)\S*)? is (un)?authorized to ([\w /]+) \((ingress|egress)\) on (\S+)"
)
_INTERCEPTED = "interceptor: Msg intercepted!"
_ROLE_LOG = "zenoh::net::routing::interceptor"
_REASONS = (
    ("sent no certificates", "no certificate"),
    ("NoCertificatesPresented", "no certificate"),
    ("peer certificate: Expired", "a certificate that has expired"),
    ("certificate expired", "a certificate that has expired"),
    ("fatal alert: CertificateExpired", "a certificate of ours that it holds for expired"),
    ("not valid yet", "a certificate that is not valid yet"),
    ("peer certificate: UnknownIssuer", "a certificate of another CA"),
    ("peer certificate: BadSignature", "a certificate of another CA"),
    ("fatal alert: UnknownCA", "it trusts another CA than ours"),
    ("fatal alert: DecryptError", "it trusts another CA than ours"),
    ("fatal alert: BadCertificate", "it does not accept our certificate"),
    ("corrupt message", "it speaks no TLS"),
    ("not the right type", "it speaks no TLS"),
)
_PERIOD_S = 60.0
_KEPT = 1024
"""Kinds of refusals, for who is refused may try ever new keys."""


class Refusals:
    """Finds refusals among the lines of Zenoh's log, and says each kind at once, then at most once a minute, counted.

    say: takes what is to be said. `counts`: how often each was refused.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self.counts: LRUCache[str, int] = LRUCache(_KEPT)
        self._say = say
        self._said: LRUCache[str, float] = LRUCache(_KEPT)
        self._last: LRUCache[str, re.Match[str]] = LRUCache(_KEPT)
        self._names: LRUCache[str, str] = LRUCache(_KEPT)

    def took(self, line: str) -> bool:
        """Whether a line is about a refusal, or only there to find some, and so is not to be shown."""
        plain = _COLOUR.sub("", line)
        link = _LINK.search(plain)
        if link is not None:
            self._note(f"refused a connection: {link_reason(link[1])}")
            return True
        if _ROLE_LOG not in plain:
            return False
        thread = (_THREAD.search(plain) or [""])[0]
        found = _ROLE.search(plain)
        if found is not None:
            if found[2] is not None:
                self._names[found[1]] = found[2]
            self._last[thread] = found
        elif _INTERCEPTED in plain:
            self._intercepted(self._last.pop(thread, None))
        return True

    def _intercepted(self, found: re.Match[str] | None) -> None:
        # What is kept from going out is no attempt of whom it was for.
        if found is not None and found[3] and found[5] == "ingress":
            role = self._names.get(found[1], "of no role")
            self._note(f"refused what a process of the role {role} tried: {found[4].lower()} {found[6]}")

    def _note(self, what: str) -> None:
        self.counts[what] = self.counts.get(what, 0) + 1
        now = time.monotonic()
        if now - self._said.get(what, -_PERIOD_S) >= _PERIOD_S:
            self._said[what] = now
            times = f" ({self.counts[what]} times)" if self.counts[what] > 1 else ""
            self._say(what + times)


def link_reason(text: str) -> str:
    """In words, why a link of TLS was not accepted."""
    known = (words for sign, words in _REASONS if sign in text)
    return next(known, text.split(" Hint:")[0].strip().rstrip("."))


def log_to_stderr(level: str = "error", roles: bool = False, say: Callable[[str], None] | None = None) -> Closing:
    """Turn on Zenoh's log on stderr, for a process of our own and before it prints; once.

    Zenoh writes it to the process's standard output: that descriptor becomes a pipe's, while `sys.stdout` keeps a copy
    of the old one. roles: find what was refused to roles too, as a hub does, which little passes; say: how refusals are
    told (default: a line on stderr). To be closed where the process ends without Python's own end.
    """
    sys.stdout.flush()
    sys.stdout = os.fdopen(os.dup(1), "w", buffering=1)
    reading, writing = os.pipe()
    os.dup2(writing, 1)
    os.close(writing)
    refusals = Refusals(say or _on_stderr)
    thread = threading.Thread(target=_pass_on, args=(reading, refusals), name="zenoh log", daemon=True)
    thread.start()
    zenoh.init_log_from_env_or(",".join([level, _LINKS, *([_ROLES] if roles else [])]))

    def end() -> None:
        os.dup2(2, 1)
        thread.join(1.0)

    closer = Closer(end)
    atexit.register(closer.close)
    return closer


def _pass_on(reading: int, refusals: Refusals) -> None:
    with os.fdopen(reading, "r", encoding="utf-8", errors="replace") as lines, suppress(ValueError, OSError):
        for line in lines:
            if not refusals.took(line):
                sys.stderr.write(line)
                sys.stderr.flush()


def _on_stderr(text: str) -> None:
    print(f"fieldpose: {text}", file=sys.stderr, flush=True)
