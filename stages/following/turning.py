"""How a camera has turned from one frame to the next, by the shift of the whole image.

Source: Klein and Murray, Improving the agility of keyframe-based SLAM (2008), who compare small blurred images too.
"""

from __future__ import annotations

import cv2
import numpy as np

from fieldpose.stages.alignment.images import FramePyramid
from fieldpose.stages.geometry import exp_se3
from fieldpose.stages.geometry.arrays import Transform


def turned(before: FramePyramid, now: FramePyramid) -> Transform | None:
    """now_from_before (4, 4), a turn on the spot that shifts the one image to the other.

    A turn about the optical axis is not seen. None for images of different sizes.
    """
    first, second = before.levels[-1], now.levels[-1]
    if first.shape != second.shape:
        return None
    window = cv2.createHanningWindow((first.shape[1], first.shape[0]), cv2.CV_32F)
    (across, down), _ = cv2.phaseCorrelate(first, second, window)
    coarser = 2 ** (len(now.levels) - 1)
    x, y = across * coarser / now.camera.fx, down * coarser / now.camera.fy
    return exp_se3([0.0, 0.0, 0.0, -np.arctan(y), np.arctan(x), 0.0])
