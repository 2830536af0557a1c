"""The five stages between a guess and a pose, as their processes run them, without a bus in between."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from fieldpose.bus.codec import decode, encode
from fieldpose.bus.messages import Frame, Guess, GuessReason, Message
from fieldpose.bus.node import Handler, Output, first_header
from fieldpose.bus.topics import FRAME, GUESS, Topic
from fieldpose.stages.geometry import Camera


def frame_message(image: np.ndarray, camera: Camera, frame_id: int = 1, encoding: Any = "rgb8") -> Frame:
    """A frame as the camera sends it."""
    return Frame(header=first_header(frame_id, frame_id), image=image, encoding=encoding, camera=camera)


def guess_message(cam_from_object: np.ndarray, camera: Camera, frame_id: int = 1, pass_index: int = 0) -> Guess:
    """A guess as tracking sends it."""
    header = first_header(frame_id, frame_id, pass_index)
    return Guess(header=header, reason=GuessReason.PRIOR, cam_from_object=cam_from_object, camera=camera)


def over_the_wire(topic: Topic[Any], message: Message) -> Message:
    """The message as a receiver has it: with read-only arrays, wherever they lie in its bytes."""
    return decode(encode(message), topic.message_type, topic.max_bytes)


def run_chain(nodes: Sequence[Handler], frame: Frame | None, guess: Guess) -> dict[Topic[Any], Any]:
    """Give each node what it reads, in order; the last message of each topic."""
    said: dict[Topic[Any], Message] = {GUESS: over_the_wire(GUESS, guess)}
    if frame is not None:
        said[FRAME] = over_the_wire(FRAME, frame)
    for node in nodes:
        for topic in reversed(node.inputs):
            if topic in said:
                _keep(said, node.handle(topic, said[topic]))
        _keep(said, node.tick(2**62))
    return said


def _keep(said: dict[Topic[Any], Message], outputs: Iterable[Output]) -> None:
    for topic, message in outputs:
        said[topic] = over_the_wire(topic, message)
