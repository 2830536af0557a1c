"""What the stages' processes share on the way between messages and the plain values of the cores."""

from __future__ import annotations

from dataclasses import asdict, fields

import numpy as np

from fieldpose.bus.messages import CameraModel, Frame, Header
from fieldpose.stages.geometry import Camera
from fieldpose.stages.images import decoded

NO_CAMERA = CameraModel(1, 1, 1.0, 1.0, 0.0, 0.0)
"""Stands for the camera in the messages of failures, where none is known."""


def camera_of(model: CameraModel) -> Camera:
    """The camera of a message."""
    return Camera(**{field.name: getattr(model, field.name) for field in fields(Camera)})


def camera_model(camera: Camera) -> CameraModel:
    """A camera for a message."""
    return CameraModel(**asdict(camera))


def frame_image(frame: Frame) -> np.ndarray | None:
    """The image (h, w, 3) uint8 RGB of a frame; None where its bytes are no image of the frame's size."""
    return decoded(frame.encoding, frame.image, frame.camera.width, frame.camera.height)


def frame_rng(header: Header) -> np.random.Generator:
    """Random numbers that a frame and pass have again when a recording is replayed."""
    return np.random.default_rng((header.frame_id, header.pass_index))
