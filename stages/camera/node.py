"""The camera as a process: frames out, each when it is due; what tracking says about them in."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

from fieldpose.bus.logs import stage_logger
from fieldpose.bus.messages import Message
from fieldpose.bus.node import TICK_S, EndOfInput, Output
from fieldpose.bus.topics import CAMERA_INFO, FAILURE, FRAME, POSE, STATE, TRUTH, Topic
from fieldpose.stages.camera.config import CameraConfig
from fieldpose.stages.camera.sender import Sender
from fieldpose.stages.geometry import Camera


class CameraNode:
    """A Handler that ends by itself, once the last frame of its source is answered, by every object of config.objects.

    `known` gives the cameras of the training views. `wait_until_ready` is called before the first frame, for instance
    to wait for the stages that will work on it. Raises FieldposeErrors at start, and at stop the one that ended the
    source early.
    """

    name = "camera"
    inputs: tuple[Topic[Any], ...] = (STATE, POSE, FAILURE)
    outputs: tuple[Topic[Any], ...] = (TRUTH, FRAME, CAMERA_INFO)

    def __init__(
        self, config: CameraConfig, known: Callable[[], Sequence[Camera]] = tuple,
        wait_until_ready: Callable[[], None] = lambda: None,
    ) -> None:  # fmt: skip
        self._config, self._known = config, known
        self._wait_until_ready = wait_until_ready
        self._sender: Sender | None = None

    @property
    def objects(self) -> tuple[str, ...]:
        """All objects that are looked for in its frames, where they are several."""
        return self._config.objects

    def start(self) -> None:
        self._sender = Sender(self._config, self._known())
        stage_logger(self.name).info("source", what=self._sender.description)
        self._wait_until_ready()

    def handle(self, topic: Topic[Any], message: Message) -> Iterable[Output]:
        return self._heard(message)

    def handle_of(self, object: str, topic: Topic[Any], message: Message) -> Iterable[Output]:
        return self._heard(message, object)

    def tick_in_s(self, now_ns: int) -> float:
        """A frame goes out when it is due, not at the next beat after that."""
        wait_s = self._opened.wait_s(now_ns)
        return TICK_S if wait_s is None else wait_s

    def tick(self, now_ns: int) -> Iterator[Output]:
        yield from self._opened.messages(now_ns)
        if self._opened.over(now_ns):
            raise EndOfInput

    def stop(self) -> None:
        if self._sender is not None:
            self._sender.close()

    def _heard(self, message: Message, object: str | None = None) -> Iterable[Output]:
        now_ns = time.time_ns()
        self._opened.heard(message, now_ns, object)
        return self.tick(now_ns)  # or an answer would wait up to 20 ms for the next frame

    @property
    def _opened(self) -> Sender:
        if self._sender is None:
            raise RuntimeError("the camera was not started")
        return self._sender
