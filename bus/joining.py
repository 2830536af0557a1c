"""Joining a stage's inputs by the frame and pass that they belong to, in bounded memory."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, TypeVar

from fieldpose.bus.messages import Header, Message
from fieldpose.bus.ports import reply_header
from fieldpose.bus.topics import JOIN_CAPACITY, Topic

M = TypeVar("M", bound=Message)

Key = tuple[int, int, int]


class Joined:
    """The inputs of one frame and pass, by topic; `missing` names those that did not come in time."""

    def __init__(self, header: Header, inputs: dict[Topic[Any], Message], missing: tuple[Topic[Any], ...] = ()) -> None:
        self.header = reply_header(header)
        self.missing = missing
        self._inputs = inputs

    def __getitem__(self, topic: Topic[M]) -> M:
        message = self.get(topic)
        if message is None:
            raise KeyError(topic.name)
        return message

    def get(self, topic: Topic[M]) -> M | None:
        """The message of a topic; None where it is missing."""
        return self._inputs.get(topic)  # type: ignore[return-value]

    @property
    def frame_key(self) -> tuple[int, int]:
        """Tells the frame from all others of its camera."""
        return self.header.frame_key


@dataclass
class _Waiting:
    message: Message
    deadline_ns: int


class Joiner:
    """The first input drives: each of its messages comes out once, joined or, after `timeout_s`, incomplete.

    The other inputs wait for it in rings. What there is one of a frame is joined without regard to the pass, and stays
    in its ring for later ones. The capture time belongs to the key, so that frames of a camera that started again are
    not mixed up. A camera sends its frames in their order, so that one is not waited for any more once a later one is
    there, as after a link was cut.
    """

    def __init__(self, inputs: tuple[Topic[Any], ...], timeout_s: float = 1.0) -> None:
        self._primary = inputs[0]
        self._rings: dict[Topic[Any], OrderedDict[Key, Message]] = {topic: OrderedDict() for topic in inputs[1:]}
        self._waiting: OrderedDict[Key, _Waiting] = OrderedDict()
        self._timeout_ns = round(timeout_s * 1e9)

    def add(self, topic: Topic[Any], message: Message, now_ns: int) -> Iterator[Joined]:
        """Take a message in; give what is complete with it, and what fell out of a full buffer."""
        if topic is self._primary:
            self._waiting[_key(topic, message.header)] = _Waiting(message, now_ns + self._timeout_ns)
        else:
            self._keep(topic, message)
        yield from [self._release(key) for key in list(self._waiting) if self._is_decided(key)]
        while len(self._waiting) > JOIN_CAPACITY:
            yield self._release(next(iter(self._waiting)))

    def expire(self, now_ns: int) -> Iterator[Joined]:
        """Give what has waited too long, incomplete."""
        late = [key for key, waiting in self._waiting.items() if waiting.deadline_ns <= now_ns]
        yield from [self._release(key) for key in late]

    def _keep(self, topic: Topic[Any], message: Message) -> None:
        ring = self._rings[topic]
        key = _key(topic, message.header)
        ring[key] = message
        ring.move_to_end(key)
        if len(ring) > kept(topic):
            ring.popitem(last=False)

    def _is_decided(self, key: Key) -> bool:
        """Whether all inputs are there, or one will not come."""
        header, missing = self._waiting[key].message.header, self._missing(key)
        return not missing or any(self._is_past(topic, header) for topic in missing)

    def _is_past(self, topic: Topic[Any], header: Header) -> bool:
        """Whether a camera has sent that of a later frame."""
        if not (topic.of_frame and topic.newest_only):
            return False
        return any(number > header.frame_id and at > header.capture_ns for number, _, at in self._rings[topic])

    def _missing(self, key: Key) -> tuple[Topic[Any], ...]:
        header = self._waiting[key].message.header
        return tuple(topic for topic, ring in self._rings.items() if _key(topic, header) not in ring)

    def _release(self, key: Key) -> Joined:
        missing = self._missing(key)
        message = self._waiting.pop(key).message
        inputs: dict[Topic[Any], Message] = {self._primary: message}
        for topic, ring in self._rings.items():
            ring_key = _key(topic, message.header)
            found = ring.get(ring_key) if topic.of_frame else ring.pop(ring_key, None)
            if found is not None:
                inputs[topic] = found
        return Joined(message.header, inputs, missing)


def kept(topic: Topic[Any]) -> int:
    """How many messages of an input a join keeps; of a newest-only topic too, for any may be the one wanted."""
    return JOIN_CAPACITY if topic.newest_only else topic.capacity


def _key(topic: Topic[Any], header: Header) -> Key:
    return header.frame_id, 0 if topic.of_frame else header.pass_index, header.capture_ns
