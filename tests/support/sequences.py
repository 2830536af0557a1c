"""Short camera sequences with true poses, in memory and as recordings."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from support.pictures import picture

from fieldpose.bus.messages import Encoding
from fieldpose.bus.recording import RecordingWriter
from fieldpose.bus.topics import Address
from fieldpose.stages.camera.core import CapturedFrame, TruePose
from fieldpose.stages.camera.wire import messages_of
from fieldpose.stages.geometry import Camera, look_at

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
STARTED_NS, MS = 5_000_000_000, 1_000_000
FIRST_ID, STEP_MS = 7, 100
_SCENE = picture(size=256)


def image(place: int) -> np.ndarray:
    """(48, 64, 3) uint8 RGB: what the camera sees as it moves along a picture."""
    return np.ascontiguousarray(_SCENE[50 : 50 + CAMERA.height, place : place + CAMERA.width])


def encoded(pixels: np.ndarray, encoding: Encoding) -> np.ndarray:
    """The image as it is, or the bytes (n,) uint8 of a file of it."""
    if encoding == "rgb8":
        return pixels
    return cv2.imencode(f".{encoding}", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR))[1].ravel()


def frames(count: int, encoding: Encoding = "rgb8", hidden: int | None = None) -> list[CapturedFrame]:
    """Frames at 10 Hz, numbered from FIRST_ID; in the `hidden` one the object is out of view."""
    return [_frame(i, encoding, i == hidden) for i in range(count)]


def _frame(i: int, encoding: Encoding, hidden: bool) -> CapturedFrame:
    truth = TruePose(None if hidden else look_at((4, 0.05 * i, 1), (0, 0, 0), (0, 0, 1)))
    at_ns = STARTED_NS + i * STEP_MS * MS
    return CapturedFrame(i + FIRST_ID, encoded(image(i), encoding), encoding, CAMERA, f"frame {i}", at_ns, truth)


def write(path: Path, shown: list[CapturedFrame]) -> Path:
    """The frames as a recording."""
    writer = RecordingWriter(path)
    for frame in shown:
        for topic, message in messages_of(frame, frame.at_ns or 0):
            writer.write(Address().key(topic), topic, message, frame.at_ns or 0)
    writer.close()
    return path
