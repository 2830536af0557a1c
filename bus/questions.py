"""Zenoh's queries: one thread takes them in, and each is answered in a thread of its own."""

from __future__ import annotations

import threading
from typing import Any

import zenoh

from fieldpose.bus.protocol import Answer, Replies, refusal

_REFUSAL = zenoh.Encoding.TEXT_PLAIN
"""Tells a stage's own words from those of Zenoh, which answers with an error when time is over."""


def feed_questions(channel: Any, key: str, answer: Answer) -> None:
    """Answer what comes until the channel ends; returns when all has been answered."""
    answering: list[threading.Thread] = []
    while True:
        try:
            query = channel.recv()
        except zenoh.ZError:
            break
        thread = threading.Thread(target=_answer, args=(query, key, answer), daemon=True)
        answering = [*(each for each in answering if each.is_alive()), thread]
        thread.start()
    for thread in answering:
        thread.join()


def _answer(query: Any, key: str, answer: Answer) -> None:
    # The asker waits until the query is dropped, whatever becomes of it here.
    with query:
        try:
            payload = answer(query.payload.to_bytes() if query.payload is not None else b"")
        except Exception as error:
            query.reply_err(refusal(key, error), encoding=_REFUSAL)
        else:
            # Who serves many keys answers under the one that was asked.
            query.reply(str(query.key_expr) if "*" in key else key, payload)


def asked(session: Any, key: str, payload: bytes, timeout_s: float) -> Replies | None:
    """What all who serve a key say; None where nobody says anything. Raises ZError."""
    answers: dict[str, bytes] = {}
    refusals: list[str] = []
    for reply in session.get(key, target=zenoh.QueryTarget.ALL, payload=payload, timeout=timeout_s):
        if reply.ok is not None:
            answers[str(reply.ok.key_expr)] = reply.ok.payload.to_bytes()
        elif reply.err.encoding == _REFUSAL:
            refusals.append(reply.err.payload.to_string())
    return Replies(answers, tuple(sorted(refusals))) if answers or refusals else None
