"""Wrong bytes made of right ones: blindly, by the words of a text, by the parts of JSON, msgpack, PNG, safetensors."""

from __future__ import annotations

import json
import random
import re
import struct
import zlib
from collections.abc import Callable
from typing import Any

import msgspec

MOST_BYTES = 1 << 20
_WORDS: tuple[bytes, ...] = (
    b"", b"nan", b"-inf", b"1e999", b"-1e308", b"1e-320", b"0", b"-1", b"2", b"9" * 400, b"9" * 5000, b"null", b"true",
    b'"x"', b"[]", b"{}", b"[[]]", b"\n", b"#", b"\x00", b"\xff", b"\xed\xa0\x80", b"../..", b"/dev/zero", b"%s",
    b"[" * 5000, b'{"a":' * 2000, b"&a ", b"*a", b"!!python/object:os.system", b"\xef\xbb\xbf", b"1_0", b"0x10", b"1:1",
)  # fmt: skip
_VALUES: tuple[Any, ...] = (
    None, True, 0, -1, 1, 2**31, 2**63 - 1, -(2**63), 2**64 - 1, 0.5, -0.0, 1e308, 1e-320, float("nan"), float("inf"),
    "", "x", "x" * 5000, "\n", "\x00", "../..", "\ud7ff", [], {}, [[]], [0] * 20, {"": 0}, b"", b"\0" * 9,
)  # fmt: skip
_NUMBERS = (0, 1, 2, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1)
_PNG = b"\x89PNG\r\n\x1a\n"


def mutated(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
    """`data` with one to four changes; `others` is what parts may be taken from."""
    for _ in range(rng.choice((1, 1, 2, 4))):
        data = rng.choice(_ways_for(data))(data, others, rng)
    return data[:MOST_BYTES]


Way = Callable[[bytes, list[bytes], random.Random], bytes]


def _ways_for(data: bytes) -> tuple[Way, ...]:
    head = data[:1]
    if data.startswith(_PNG):
        return (_png, _png, *_BLIND)
    if head in (b"{", b"["):
        return (_json, _json, _json, _word, *_BLIND)
    if data[8:9] == b"{" and int.from_bytes(data[:8], "little") <= len(data):
        return (_safetensors, _safetensors, _safetensors, *_BLIND)
    if head and 0x80 <= head[0] <= 0x9F:
        return (_msgpack, _msgpack, *_BLIND)
    return (_word, _word, *_BLIND) if _is_text(data) else _BLIND


def _is_text(data: bytes) -> bool:
    return b"\x00" not in data[:512]


def _flip(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
    if not data:
        return rng.randbytes(8)
    at, changed = rng.randrange(len(data)), bytearray(data)
    changed[at] = rng.choice((changed[at] ^ (1 << rng.randrange(8)), rng.randrange(256)))
    return bytes(changed)


def _cut(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
    first, end = sorted((rng.randrange(len(data) + 1), rng.randrange(len(data) + 1)))
    return data[:first] if rng.random() < 0.3 else data[:first] + data[min(end, first + 64) :]


def _insert(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
    at = rng.randrange(len(data) + 1)
    return data[:at] + rng.choice((rng.choice(_WORDS), rng.randbytes(rng.randrange(1, 9)))) + data[at:]


def _repeat(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
    at = rng.randrange(len(data) + 1)
    part = data[at : at + rng.choice((1, 8, 64, 512))]
    return data[:at] + part * rng.choice((2, 3, 50, 1000)) + data[at + len(part) :]


def _splice(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
    other = rng.choice(others) if others else data
    return data[: rng.randrange(len(data) + 1)] + other[rng.randrange(len(other) + 1) :]


def _number(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
    if len(data) < 9:
        return rng.randbytes(9)
    size, order = rng.choice((1, 2, 4, 8)), rng.choice("<>")
    at = rng.randrange(min(len(data) - size, 256) if rng.random() < 0.5 else len(data) - size)
    number = rng.choice(_NUMBERS) % (1 << 8 * size)
    return data[:at] + struct.pack(order + "xBHxIxxxQ"[size], number) + data[at + size :]


_BLIND: tuple[Way, ...] = (_flip, _flip, _cut, _insert, _repeat, _splice, _number)


def _word(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
    words = [match.span() for match in re.finditer(rb"[^\s,:\[\]{}<>]+", data[:20000])] or [(0, 0)]
    first, end = rng.choice(words)
    return data[:first] + rng.choice(_WORDS) + data[end:]


def _json(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
    try:
        return json.dumps(_part(json.loads(data), rng), default=str).encode("utf-8", "surrogatepass")
    except (ValueError, RecursionError):
        return _word(data, others, rng)


def _msgpack(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
    try:
        return msgspec.msgpack.encode(_part(msgspec.msgpack.decode(data), rng))
    except (ValueError, TypeError, OverflowError, RecursionError, msgspec.MsgspecError):
        return _flip(data, others, rng)


def _safetensors(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
    size = int.from_bytes(data[:8], "little")
    try:
        header = json.loads(data[8 : 8 + size])
        stated = header.get("__metadata__", {})
        if rng.random() < 0.7 and "fieldpose" in stated:
            stated["fieldpose"] = json.dumps(_part(json.loads(stated["fieldpose"]), rng), default=str)
        else:
            header = _part(header, rng)
        text = json.dumps(header, default=str).encode()
    except (ValueError, RecursionError, AttributeError, TypeError):
        return _flip(data, others, rng)
    return struct.pack("<Q", len(text)) + text + data[8 + size :]


def _png(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
    """Change a chunk, and make its checksum right, without which nobody looks into it."""
    chunks, at = [], len(_PNG)
    while at + 12 <= len(data):
        size = int.from_bytes(data[at : at + 4], "big")
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size
    if not chunks:
        return _flip(data, others, rng)
    chosen = rng.randrange(len(chunks))
    name, content = chunks[chosen]
    chunks[chosen] = (name, rng.choice((_flip, _number, _cut, _insert))(content, others, rng))
    return _PNG + b"".join(
        struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body)) for name, body in chunks
    )


def _part(value: Any, rng: random.Random) -> Any:
    """A tree of lists and maps in which one part is another, gone, there twice, or of another type."""
    if isinstance(value, dict) and value and rng.random() < 0.9:
        key = rng.choice(list(value))
        action = rng.random()
        rest = {k: v for k, v in value.items() if k != key}
        if action < 0.1:
            return rest
        if action < 0.15:
            return {**rest, rng.choice(("", "x", "version", "header")): value[key]}
        return {**value, key: _part(value[key], rng)}
    if isinstance(value, list) and value and rng.random() < 0.8:
        at = rng.randrange(len(value))
        action = rng.random()
        if action < 0.15:
            return value[:at] + value[at + 1 :]
        if action < 0.25:
            return value[:at] + [value[at]] * rng.choice((2, 20, 500)) + value[at:]
        return [*value[:at], _part(value[at], rng), *value[at + 1 :]]
    if isinstance(value, bytes) and value and rng.random() < 0.5:
        return mutated(value, [], rng)
    if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e18 and rng.random() < 0.4:
        return rng.choice((-value, value * 1e30, value + 1, int(value), str(value), [value]))
    return rng.choice(_VALUES)
