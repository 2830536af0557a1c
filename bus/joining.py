"""Joining a stage's inputs by the frame and pass that they belong to, in bounded memory."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

from fieldpose.bus.messages import Header, Message
from fieldpose.bus.topics import FRAME, JOIN_CAPACITY, Topic

Key = tuple[int, int, int]


class Joined(NamedTuple):
    """The inputs of one frame and pass; `missing` names those that did not come in time."""

    inputs: dict[Topic, Message]
    missing: tuple[Topic, ...]


@dataclass
class _Waiting:
    message: Message
    deadline_ns: int


class Joiner:
    """The first input drives: each of its messages comes out once, joined or, after `timeout_s`, incomplete.

    The other inputs wait for it in rings. Frames are joined by their id alone and stay in their ring, for later
    passes. The capture time belongs to the key, so that frames of a camera that started again are not mixed up.
    """

    def __init__(self, inputs: tuple[Topic, ...], timeout_s: float = 1.0) -> None:
        self._primary = inputs[0]
        self._rings: dict[Topic, OrderedDict[Key, Message]] = {topic: OrderedDict() for topic in inputs[1:]}
        self._waiting: OrderedDict[Key, _Waiting] = OrderedDict()
        self._timeout_ns = round(timeout_s * 1e9)

    def add(self, topic: Topic, message: Message, now_ns: int) -> Iterator[Joined]:
        """Take a message in; give what is complete with it, and what fell out of a full buffer."""
        if topic == self._primary:
            self._waiting[_key(topic, message.header)] = _Waiting(message, now_ns + self._timeout_ns)
        else:
            self._keep(topic, message)
        yield from [self._release(key) for key in list(self._waiting) if not self._missing(key)]
        while len(self._waiting) > JOIN_CAPACITY:
            yield self._release(next(iter(self._waiting)))

    def expire(self, now_ns: int) -> Iterator[Joined]:
        """Give what has waited too long, incomplete."""
        late = [key for key, waiting in self._waiting.items() if waiting.deadline_ns <= now_ns]
        yield from [self._release(key) for key in late]

    def _keep(self, topic: Topic, message: Message) -> None:
        ring = self._rings[topic]
        key = _key(topic, message.header)
        ring[key] = message
        ring.move_to_end(key)
        if len(ring) > kept(topic):
            ring.popitem(last=False)

    def _missing(self, key: Key) -> tuple[Topic, ...]:
        header = self._waiting[key].message.header
        return tuple(topic for topic, ring in self._rings.items() if _key(topic, header) not in ring)

    def _release(self, key: Key) -> Joined:
        missing = self._missing(key)
        message = self._waiting.pop(key).message
        inputs = {self._primary: message}
        for topic, ring in self._rings.items():
            ring_key = _key(topic, message.header)
            found = ring.get(ring_key) if topic == FRAME else ring.pop(ring_key, None)
            if found is not None:
                inputs[topic] = found
        return Joined(inputs, missing)


def kept(topic: Topic) -> int:
    """How many messages of an input a join keeps; of a newest-only topic too, for any may be the one wanted."""
    return JOIN_CAPACITY if topic.newest_only else topic.capacity


def _key(topic: Topic, header: Header) -> Key:
    return header.frame_id, 0 if topic == FRAME else header.pass_index, header.capture_ns
