"""What the stages' processes share on the way between messages and the plain values of the cores."""

from __future__ import annotations

from collections import OrderedDict

import cv2
import numpy as np

from fieldpose.bus.messages import Frame

_KEPT_IMAGES = 4


class FrameImages:
    """The images of the last frames, each decoded once, whoever of this process looks at it."""

    def __init__(self) -> None:
        self._images: OrderedDict[tuple[int, int], np.ndarray | None] = OrderedDict()

    def of(self, frame: Frame) -> np.ndarray | None:
        """(h, w, 3) uint8 RGB; None where its bytes are no image of the frame's size."""
        key = (frame.header.frame_id, frame.header.capture_ns)
        if key not in self._images:
            self._images[key] = frame_image(frame)
            while len(self._images) > _KEPT_IMAGES:
                self._images.popitem(last=False)
        return self._images[key]


def frame_image(frame: Frame) -> np.ndarray | None:
    """The image (h, w, 3) uint8 RGB of a frame; None where its bytes are no image of the frame's size."""
    if frame.encoding == "rgb8":
        return frame.image
    try:
        bgr = cv2.imdecode(frame.image, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        return None
    if bgr is None or bgr.shape[:2] != (frame.camera.height, frame.camera.width):
        return None
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)
