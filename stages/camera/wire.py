"""From captured frames to the messages on the bus."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from fieldpose.bus.messages import CameraInfo, Frame, Truth
from fieldpose.bus.node import Output, first_header
from fieldpose.bus.topics import CAMERA_INFO, FRAME, TRUTH
from fieldpose.stages.camera.core import CapturedFrame


def messages_of(frame: CapturedFrame, capture_ns: int) -> Iterator[Output]:
    """What is known of the frame's pose, where anything is, then the frame, and then what it is without its pixels."""
    header = first_header(frame.frame_id, capture_ns)
    if frame.truth is not None:
        known = frame.truth.cam_from_object
        yield TRUTH, Truth(header=header, cam_from_object=None if known is None else np.array(known, np.float64))
    yield (
        FRAME,
        Frame(
            header=header, image=np.ascontiguousarray(frame.image), encoding=frame.encoding, camera=frame.camera,
            camera_origin=frame.origin,
        ),
    )  # fmt: skip
    yield CAMERA_INFO, CameraInfo(header=header, camera=frame.camera, camera_origin=frame.origin)
