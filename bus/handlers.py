"""What a stage implements: a Handler, or a JoinedHandler where it needs several inputs of a frame."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from typing import Any, Protocol, runtime_checkable

from fieldpose.bus.joining import Joined, Joiner
from fieldpose.bus.logs import Throttle, describe, stage_logger
from fieldpose.bus.messages import Failure, Message, Reason
from fieldpose.bus.requests import Request, Response
from fieldpose.bus.topics import FAILURE, FRAME, Topic

Output = tuple[Topic[Any], Message]


class EndOfInput(Exception):  # noqa: N818 - as StopIteration, it is no failure
    """Raised by a handler that has nothing more to send: its process ends cleanly."""


class Handler(Protocol):
    """What a stage does; all methods are called from one thread."""

    @property
    def name(self) -> str:
        """The process's name on the bus."""

    @property
    def inputs(self) -> tuple[Topic[Any], ...]:
        """What it reads."""

    @property
    def outputs(self) -> tuple[Topic[Any], ...]:
        """What it may send."""

    def start(self) -> None:
        """Load, compile, warm up; the process is not ready before this returns."""

    def handle(self, topic: Topic[Any], message: Message) -> Iterable[Output]:
        """Answer a message; an exception is counted as failed and the process goes on."""

    def tick(self, now_ns: int) -> Iterable[Output]:
        """Called at least every 20 ms while no message is being handled, for deadlines and sources."""

    def stop(self) -> None:
        """Let go of what `start` took; called also when `start` was interrupted."""


@runtime_checkable
class KeepsTime(Protocol):
    """A handler whose next tick is not to wait for the usual 20 ms."""

    def tick_in_s(self, now_ns: int) -> float:
        """How long until `tick` is to be called, at most."""


@runtime_checkable
class Controlled(Protocol):
    """A handler that takes requests, in the thread of its other methods."""

    def control(self, request: Request[Any], now_ns: int) -> tuple[Response, Iterable[Output]]:
        """Carry out a request; how things are then, and what is to be sent. Raises FieldposeError to refuse it."""


@runtime_checkable
class HearsObjects(Protocol):
    """A handler that hears several objects of its camera, and is told whose a message is."""

    @property
    def objects(self) -> tuple[str, ...]:
        """Their names; none where it hears its own alone."""

    def handle_of(self, object: str, topic: Topic[Any], message: Message) -> Iterable[Output]:
        """As `handle`, of a message of one of them."""


class JoinedHandler:
    """A handler that gets its inputs joined by frame and pass, and never answers with silence.

    `inputs[0]` drives: each of its messages is answered once, on `output` or with a Failure. A subclass sets `name`,
    `inputs` and `output`, and `optional` for inputs that it can do without, and implements `answer`. One that defines
    `__init__` calls this one's.
    """

    name: str
    inputs: tuple[Topic[Any], ...]
    output: Topic[Any]
    optional: tuple[Topic[Any], ...] = ()
    join_timeout_s: float = 1.0

    def __init__(self) -> None:
        self.failed = 0
        self._joiner = Joiner(self.inputs, self.join_timeout_s)
        self._throttle = Throttle(stage_logger(self.name))

    @property
    def outputs(self) -> tuple[Topic[Any], ...]:
        """What it sends."""
        return (self.output, FAILURE)

    def start(self) -> None:
        """Nothing to load unless a subclass says so."""

    def stop(self) -> None:
        """Nothing to let go unless a subclass says so."""

    def answer(self, joined: Joined) -> Message | Reason:
        """The message for the joined inputs, or why there is none. An exception becomes INTERNAL_ERROR."""
        raise NotImplementedError

    def handle(self, topic: Topic[Any], message: Message) -> Iterator[Output]:
        for joined in self._joiner.add(topic, message, time.time_ns()):
            yield self._reply(joined)

    def tick(self, now_ns: int) -> Iterator[Output]:
        for joined in self._joiner.expire(now_ns):
            yield self._reply(joined)

    def _reply(self, joined: Joined) -> Output:
        answer = self._answered(joined)
        if isinstance(answer, Reason):
            return FAILURE, Failure(header=joined.header, stage=self.name, reason=answer)
        return self.output, answer

    def _answered(self, joined: Joined) -> Message | Reason:
        needed = [topic for topic in joined.missing if topic not in self.optional]
        if needed:
            self._throttle.warning("input missing", inputs=", ".join(topic.name for topic in needed))
            return Reason.FRAME_MISSING if FRAME in needed else Reason.INPUT_MISSING
        try:
            answer: object = self.answer(joined)
            if not isinstance(answer, Message | Reason):
                raise TypeError(f"answered with a {type(answer).__name__}")
            return answer
        except Exception as error:
            self.failed += 1
            self._throttle.warning("failed", error=describe(error))
            return Reason.INTERNAL_ERROR
