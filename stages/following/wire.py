"""Frames as following looks at them."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from fieldpose.bus.messages import Frame
from fieldpose.stages.alignment.images import FramePyramid
from fieldpose.stages.following.config import LEVELS
from fieldpose.stages.following.core import Followed
from fieldpose.stages.geometry import Camera, unscale_pixels
from fieldpose.stages.images import encoded_size

See = Callable[[Frame], "FramePyramid | None"]

_REDUCED = {8: cv2.IMREAD_REDUCED_GRAYSCALE_8, 4: cv2.IMREAD_REDUCED_GRAYSCALE_4, 2: cv2.IMREAD_REDUCED_GRAYSCALE_2}
"""JPEG files are decoded to so many times smaller images in a fraction of the time."""


def small_frame(frame: Frame, longer_side: int) -> FramePyramid | None:
    """The frame's grey values, its longer side at most `longer_side`; None where its bytes are no image of its size."""
    grey = _grey(frame, longer_side)
    if grey is None:
        return None
    camera = frame.camera.shrunk(longer_side)
    if grey.shape != (camera.height, camera.width):
        grey = cv2.resize(grey, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return FramePyramid.of(grey, camera, longer_side, LEVELS)


def in_frame(followed: Followed, camera: Camera) -> np.ndarray:
    """The points' pixels (n, 2) float32 in the frame as its camera, of whose shrunk image they are, took it."""
    small = camera.shrunk(followed.longer_side)
    scale = np.array([small.width / camera.width, small.height / camera.height])
    pixels: np.ndarray = unscale_pixels(followed.pixels, scale).astype(np.float32)
    return pixels


def _grey(frame: Frame, longer_side: int) -> np.ndarray | None:
    camera, image = frame.camera, np.asarray(frame.image)
    if frame.encoding == "rgb8":
        return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    # A reduced image of another size would cover more than the frame does.
    sizes = camera.width, camera.height
    if encoded_size(image) != sizes:
        return None
    fitting = (by for by in _REDUCED if max(sizes) >= by * longer_side and all(size % by == 0 for size in sizes))
    by = next(fitting, 1) if frame.encoding == "jpeg" else 1
    flag = _REDUCED.get(by, cv2.IMREAD_GRAYSCALE)
    try:
        grey = cv2.imdecode(image, flag | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        return None
    expected = (-(-camera.height // by), -(-camera.width // by))
    return grey if grey is not None and grey.shape == expected else None
