"""Images as patches are looked for in them: grey values, coarse to fine."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float64

from fieldpose.stages.geometry import Camera
from fieldpose.stages.geometry.arrays import Grey
from fieldpose.stages.images import shrunk_with_camera

_PER_LEVEL_OF_GREY = np.float32(1 / 255)


def pyramid(grey: Grey, levels: int) -> list[np.ndarray]:
    """The image as float32 in 0..1, then each half as large as the one before, whose pixel 2 x is its pixel x."""
    images: list[np.ndarray] = [grey.astype(np.float32) * _PER_LEVEL_OF_GREY]
    while len(images) < levels:
        images.append(cv2.pyrDown(images[-1]))
    return images


@dataclass(frozen=True)
class FramePyramid:
    """A frame, shrunk to the size of views; camera: its camera then; scale: (x, y), shrunk / given."""

    levels: list[np.ndarray]
    camera: Camera
    scale: Float64[np.ndarray, 2]

    @classmethod
    def of(cls, grey: Grey, camera: Camera, longer_side: int, levels: int) -> FramePyramid:
        """Of a frame's grey values (h, w), maybe shrunk already; camera: of the frame as it was taken."""
        here = camera.resized(grey.shape[1], grey.shape[0])
        small, small_camera = shrunk_with_camera(grey, here, longer_side)
        scale = np.array([small_camera.width / camera.width, small_camera.height / camera.height])
        return cls(pyramid(small, levels), small_camera, scale)
