"""From captured frames to the messages on the bus."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from fieldpose.bus.messages import CameraInfo, CameraOrigin, Encoding, Frame, Header, Truth
from fieldpose.bus.node import Output, first_header
from fieldpose.bus.topics import CAMERA_INFO, FRAME, TRUTH
from fieldpose.stages.camera.core import CapturedFrame
from fieldpose.stages.geometry import Camera


def messages_of(frame: CapturedFrame, capture_ns: int) -> Iterator[Output]:
    """What is known of the frame's pose, where anything is, and then the frame."""
    header = first_header(frame.frame_id, capture_ns)
    if frame.truth is not None:
        known = frame.truth.cam_from_object
        yield TRUTH, Truth(header=header, cam_from_object=None if known is None else np.array(known, np.float64))
    yield from frame_messages(header, frame.image, frame.encoding, frame.camera, frame.origin)


def frame_messages(
    header: Header, image: np.ndarray, encoding: Encoding, camera: Camera, origin: CameraOrigin
) -> Iterator[Output]:
    """A frame, and then what it is without its pixels; image: (h, w, 3) uint8 RGB or the bytes (n,) of its file."""
    pixels = np.ascontiguousarray(image)
    yield FRAME, Frame(header=header, image=pixels, encoding=encoding, camera=camera, camera_origin=origin)
    yield CAMERA_INFO, CameraInfo(header=header, camera=camera, camera_origin=origin)
