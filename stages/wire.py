"""What the stages' processes share on the way between messages and the plain values of the cores."""

from __future__ import annotations

import numpy as np
from cachetools import LRUCache

from fieldpose.bus.messages import Frame
from fieldpose.stages.images import decoded

_KEPT_IMAGES = 4


class FrameImages:
    """The images of the last frames, each decoded once, whoever of this process looks at it."""

    def __init__(self) -> None:
        self._images: LRUCache[tuple[int, int], np.ndarray | None] = LRUCache(_KEPT_IMAGES)

    def of(self, frame: Frame) -> np.ndarray | None:
        """(h, w, 3) uint8 RGB; None where its bytes are no image of the frame's size."""
        key = frame.header.frame_key
        if key not in self._images:
            self._images[key] = frame_image(frame)
        return self._images[key]


def frame_image(frame: Frame) -> np.ndarray | None:
    """The image (h, w, 3) uint8 RGB of a frame; None where its bytes are no image of the frame's size."""
    return decoded(frame.encoding, frame.image, frame.camera.width, frame.camera.height)
