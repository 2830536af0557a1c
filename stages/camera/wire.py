"""From captured frames to the messages on the bus."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from fieldpose.bus.messages import Frame, Truth
from fieldpose.bus.node import Output, first_header
from fieldpose.bus.topics import FRAME, TRUTH
from fieldpose.stages.camera.core import CapturedFrame
from fieldpose.stages.wire import camera_model


def messages_of(frame: CapturedFrame, capture_ns: int) -> Iterator[Output]:
    """What is known of the frame's pose, where anything is, and then the frame."""
    header = first_header(frame.frame_id, capture_ns)
    if frame.truth is not None:
        known = frame.truth.cam_from_object
        yield TRUTH, Truth(header=header, cam_from_object=None if known is None else np.array(known, np.float64))
    image, camera = np.ascontiguousarray(frame.image), camera_model(frame.camera)
    yield FRAME, Frame(header=header, image=image, encoding=frame.encoding, camera=camera)
