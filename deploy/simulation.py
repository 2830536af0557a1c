"""A live run in one process and a time of its own: every answer comes as late as it is said to take.

What is found of a recorded sequence then depends on no machine: frames come at the times of their capture, following
answers at once, and what solving says reaches tracking so much later than it was asked for.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from fieldpose.bus.messages import Failure, Frame, Message, Pose, Retrieved, State, View
from fieldpose.bus.node import Handler
from fieldpose.bus.topics import Topic
from fieldpose.deploy.graph import CAMERA, HUB, RECORDER, Launch, rows_of
from fieldpose.deploy.local import Said, stamped
from fieldpose.deploy.parts import Parts
from fieldpose.stages.camera.config import CameraConfig
from fieldpose.stages.camera.sources import open_source
from fieldpose.stages.camera.wire import messages_of
from fieldpose.stages.tracking.node import TrackingNode

_NS_PER_MS = 1_000_000
_BEGINS_NS = 1_000_000_000


@dataclass(frozen=True)
class Delays:
    """How long after it was asked for a view, retrieved training views, or a pose reaches tracking, in milliseconds."""

    look_ms: float = 40.0
    view_ms: float = 60.0
    solve_ms: float = 150.0

    def of(self, message: Message) -> float:
        """That of a message for tracking."""
        match message:
            case View():
                return self.view_ms
            case Retrieved() | Failure(stage="retrieval"):
                return self.look_ms
            case Pose() | Failure():
                return self.solve_ms
        return 0.0


class Simulation:
    """Plays a plan's source, whose frames have times of their own. Raises what the handlers raise at start."""

    def __init__(self, parts: Parts, delays: Delays | None = None) -> None:
        self._camera, self._delays = parts.settings.camera, delays or Delays()
        rows = [row for row in rows_of(parts.plan, recorded=False) if row.name not in (HUB, RECORDER, CAMERA)]
        handlers = [row.make(parts, Launch()) for row in rows if row.make is not None]
        self._tracking = next(handler for handler in handlers if isinstance(handler, TrackingNode))
        self._tracking.clock = lambda: self._now_ns
        self._solving: list[Handler] = [handler for handler in handlers if handler is not self._tracking]
        self._now_ns = _BEGINS_NS
        self._numbers = itertools.count()
        self._due: list[tuple[int, int, Topic[Any], Message]] = []
        for handler in handlers:
            handler.start()

    def play(self) -> Iterator[Said]:
        """Everything that the camera and tracking say, in order."""
        for at_ns, topic, message in _frames(self._camera):
            yield from self._until(at_ns)
            said = stamped(message, CAMERA)
            yield Said(topic, said, CAMERA, 0.0)
            if isinstance(message, Frame):  # which the stages keep until they are asked
                for handler in self._solving:
                    if topic in handler.inputs:
                        list(handler.handle(topic, said))
            if topic in self._tracking.inputs:
                yield from self._handed(topic, said)
        yield from self._until(self._now_ns + round(2 * self._delays.solve_ms * _NS_PER_MS))

    def _until(self, at_ns: int) -> Iterator[Said]:
        """Hand over what is due before, and let tracking see what time it is."""
        while self._due and self._due[0][0] <= at_ns:
            self._now_ns, _, topic, message = heapq.heappop(self._due)
            yield from self._handed(topic, message)
        self._now_ns = max(at_ns, self._now_ns)
        yield from self._said(self._tracking.tick(self._now_ns))

    def _handed(self, topic: Topic[Any], message: Message) -> Iterator[Said]:
        yield from self._said(self._tracking.handle(topic, message))

    def _said(self, outputs: Any) -> Iterator[Said]:
        for topic, message in list(outputs):
            said = stamped(message, self._tracking.name)
            yield Said(topic, said, self._tracking.name, 0.0)
            self._solve(topic, said)

    def _solve(self, topic: Topic[Any], message: Message) -> None:
        """Have the other stages do their work now, and what they say for tracking handed over when it is due."""
        waiting = [(topic, message)]
        while waiting:
            topic, message = waiting.pop(0)
            for handler in self._solving:
                if topic in handler.inputs:
                    waiting += [(t, stamped(m, handler.name)) for t, m in handler.handle(topic, message)]
            if topic in self._tracking.inputs and not isinstance(message, State):
                due_ns = self._now_ns + round(self._delays.of(message) * _NS_PER_MS)
                heapq.heappush(self._due, (due_ns, next(self._numbers), topic, message))


def _frames(config: CameraConfig) -> Iterator[tuple[int, Topic[Any], Message]]:
    """Messages of a source, each with the time at which it is sent: that of its capture, and never before the last."""
    now_ns = first_ns = None
    for frame in itertools.islice(open_source(config, ()).frames(0), config.frames):
        at_ns = frame.at_ns or 0
        first_ns = at_ns if first_ns is None else first_ns
        capture_ns = _BEGINS_NS + at_ns - first_ns
        now_ns = capture_ns if now_ns is None else max(now_ns, capture_ns)
        for topic, message in messages_of(frame, capture_ns):
            yield now_ns, topic, message
