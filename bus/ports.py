"""Typed ends of a bus: an Outbox fills in headers and encodes, an Inbox queues, decodes and counts gaps."""

from __future__ import annotations

import copy
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import msgspec
from cachetools import LRUCache

from fieldpose.bus.codec import decode, decode_header, encode
from fieldpose.bus.messages import Header, Message
from fieldpose.bus.senders import KEPT, Numbers, Senders
from fieldpose.bus.topics import Address, Topic
from fieldpose.bus.transport import Bus, Closing
from fieldpose.errors import CodecError


def first_header(frame_id: int, capture_ns: int, pass_index: int = 0) -> Header:
    """The header of a message that answers no other; sender and sequence are filled in when it is sent."""
    return Header("", 0, frame_id, pass_index, capture_ns, 0)


def reply_header(header: Header) -> Header:
    """The header of an answer: same frame, pass and capture time; the rest is filled in when it is sent."""
    return first_header(header.frame_id, header.capture_ns, header.pass_index)


class Outbox:
    """Sends messages of one source; numbers them from 0 per topic."""

    def __init__(self, bus: Bus, address: Address, source: str) -> None:
        self.published = 0
        self._instance = 1 + secrets.randbits(52)
        self._bus = bus
        self._address = address
        self._source = source
        self._sequence: dict[str, int] = {}

    def announce(self) -> Closing:
        """Hold the token by which receivers know this sender from others who take its name."""
        return self._bus.hold(self._address.sender(self._source, self._instance))

    def publish(self, topic: Topic[Any], message: Message) -> None:
        """Send `message` with source, sequence and sending time filled in. Raises CodecError, TransportError."""
        sequence = self._sequence.get(topic.name, 0)
        sent = copy.copy(message)
        sent.header = msgspec.structs.replace(
            message.header, source=self._source, sequence=sequence, sent_ns=time.time_ns(), instance=self._instance
        )
        payload = encode(sent)
        if len(payload) > topic.max_bytes:
            raise CodecError(f"{topic.name}: {len(payload)} bytes where at most {topic.max_bytes} are received")
        self._bus.put(self._address.key(topic, self._source), payload, topic)
        self._sequence[topic.name] = sequence + 1
        self.published += 1


MOST_MISSING = 10_000_000
"""Before one message: those of a camera of 100 Hz in a day."""


class Sequences:
    """What is missing per sender, from the numbers in the headers; a restart is no gap.

    Neither is joining late, unless `from_start` says that each sender's number 0 should have come. expected: by key and
    sender, the number that its next message should have. A number that no sender can have come to since the last tells
    nothing. Of the longest silent of very many senders nothing is kept.
    """

    def __init__(self, from_start: bool = False, expected: Mapping[tuple[str, str], int] | None = None) -> None:
        self._from_start = from_start
        self.missing: LRUCache[tuple[str, str], int] = LRUCache(KEPT)
        self._next: LRUCache[tuple[str, str], tuple[int | None, int]] = LRUCache(KEPT)
        self._next.update({sender: (None, number) for sender, number in (expected or {}).items()})
        self._numbers = Numbers()

    @property
    def expected(self) -> dict[tuple[str, str], int]:
        """By key and sender, the number that its next message should have."""
        return {sender: number for sender, (_, number) in self._next.items()}

    def seen(self, key: str, header: Header) -> int:
        """Note a message received on `key`; return how many of its sender's are missing just before it."""
        sender = (key, header.source)
        first = (header.instance, 0 if self._from_start else header.sequence)
        instance, expected = self._next.get(sender, first)
        # Another instance, or a smaller number than expected, is a sender that started again, from 0.
        again = instance not in (None, header.instance) or header.sequence < expected
        gap = header.sequence if again else header.sequence - expected
        if not self._numbers.follows(key, header, time.monotonic()) or gap > MOST_MISSING:
            gap = 0
        else:
            self._next[sender] = (header.instance, header.sequence + 1)
        self.missing[sender] = self.missing.get(sender, 0) + gap
        return gap


class Received(NamedTuple):
    topic: Topic
    message: Message
    key: str
    received_ns: int


@dataclass
class InboxCounts:
    """`gaps` are messages that should have come; `skipped` those that a newest-only queue let go on purpose."""

    received: int = 0
    refused: int = 0
    gaps: int = 0
    skipped: int = 0


@dataclass
class _Queue:
    topic: Topic
    capacity: int
    items: deque[tuple[int, str, bytes, int]] = field(default_factory=deque)


class Inbox:
    """Bounded queues of several topics, read by one thread in the order of arrival.

    What is by nobody whom Senders believe, or no message by its head, is refused before it takes any other's place.
    `capacities` replaces the table's bound for some topics; `refused(topic, error)` is told of each payload that is
    no message; `arrived` is notified of each that comes, for one thread that reads several inboxes.
    """

    def __init__(
        self,
        bus: Bus,
        address: Address,
        topics: Iterable[Topic[Any]],
        capacities: Mapping[Topic[Any], int] | None = None,
        refused: Callable[[Topic[Any], CodecError], None] | None = None,
        arrived: threading.Condition | None = None,
    ) -> None:
        self.counts = InboxCounts()
        self._sequences = Sequences()
        self._senders = Senders(bus, address.site)
        self._refused = refused
        self._arrival = 0
        self._arrived = arrived or threading.Condition()
        self._queues = [_Queue(topic, (capacities or {}).get(topic, topic.capacity)) for topic in topics]
        self._newest_only = {queue.topic for queue in self._queues if queue.capacity == 1}
        self._subscriptions: list[Closing] = [
            bus.subscribe(address.key(queue.topic), self._sink(queue), queue.capacity) for queue in self._queues
        ]

    def get(self, timeout_s: float) -> Received | None:
        """The oldest message, waiting up to `timeout_s` for one; None after that."""
        deadline = time.monotonic() + timeout_s
        while True:
            item = self._take(max(0.0, deadline - time.monotonic()))
            if item is None:
                return None
            received = self._decode(*item)
            if received is not None:
                return received

    @property
    def has_some(self) -> bool:
        """Whether anything waits, be it a message or not."""
        return any(queue.items for queue in self._queues)

    def drain(self) -> list[Received]:
        """Every message that is here now."""
        return list(iter(lambda: self.get(0.0), None))

    def close(self) -> None:
        for subscription in self._subscriptions:
            subscription.close()
        self._senders.close()

    def _sink(self, queue: _Queue) -> Callable[[str, bytes, int], None]:
        def sink(key: str, payload: bytes, received_ns: int) -> None:
            doubt = self._doubt(queue.topic, key, payload)
            if doubt is not None:
                self._refuse(queue.topic, doubt)
                return
            with self._arrived:
                arrival = self._arrival = self._arrival + 1
                if len(queue.items) >= queue.capacity:
                    dropped = queue.items.popleft()
                    # The newest keeps its predecessor's place, else a fast camera would starve behind other topics.
                    arrival = dropped[0] if queue.capacity == 1 else arrival
                queue.items.append((arrival, key, payload, received_ns))
                self._arrived.notify()

        return sink

    def _doubt(self, topic: Topic[Any], key: str, payload: bytes) -> CodecError | None:
        try:
            if len(payload) > topic.max_bytes:
                raise CodecError(f"{len(payload)} bytes where at most {topic.max_bytes} are allowed")
            why = self._senders.doubt(topic, key, decode_header(payload))
        except CodecError as error:
            return CodecError(f"{topic.message_type.__name__}: {error}")
        return None if why is None else CodecError(why)

    def _refuse(self, topic: Topic[Any], error: CodecError) -> None:
        with self._arrived:
            self.counts.refused += 1
        if self._refused is not None:
            self._refused(topic, error)

    def _take(self, timeout_s: float) -> tuple[Topic[Any], str, bytes, int] | None:
        with self._arrived:
            if not self.has_some and timeout_s > 0:
                self._arrived.wait(timeout_s)
            waiting = [queue for queue in self._queues if queue.items]
            if not waiting:
                return None
            queue = min(waiting, key=lambda queue: queue.items[0][0])
            return queue.topic, *queue.items.popleft()[1:]

    def _decode(self, topic: Topic[Any], key: str, payload: bytes, received_ns: int) -> Received | None:
        try:
            message = decode(payload, topic.message_type, topic.max_bytes)
        except CodecError as error:
            self._refuse(topic, error)
            return None
        self.counts.received += 1
        gap = self._sequences.seen(key, message.header)
        if topic in self._newest_only:
            self.counts.skipped += gap
        else:
            self.counts.gaps += gap
        return Received(topic, message, key, received_ns)
