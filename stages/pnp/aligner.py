"""Placing points of the view in the frame by comparing the two, once the pose is nearly known.

Features move on surfaces that are seen from elsewhere, and many are matched wrongly. A pose that RANSAC has found tells
where every point of the view must be, matched or a landmark, and how its surroundings are warped there, so that the
patch around it in the view can be looked for in the frame: coarsely first, then to a fraction of a pixel. What is found
gives a better pose, and the share that is found tells whether the pose is right at all.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from fieldpose.stages.alignment.constants import FOUND_PX
from fieldpose.stages.alignment.images import FramePyramid
from fieldpose.stages.alignment.placing import Placed, place, warped
from fieldpose.stages.alignment.views import ViewPoints
from fieldpose.stages.geometry import Camera
from fieldpose.stages.geometry.arrays import Depth, FrameImage, Grey, Image, Points, Transform
from fieldpose.stages.pnp.config import PnpConfig

_LOOSER = 1.4
"""Errors before a round are larger than after the last by this and by how coarse the round is."""


@dataclass(frozen=True)
class Pictures:
    """The rendered view that gave the points, and the frame whose pose is wanted.

    depth, camera (undistorted) and cam_from_object are the view's.
    """

    view: Image
    depth: Depth
    camera: Camera
    cam_from_object: Transform
    frame: FrameImage

    @cached_property
    def grey(self) -> Grey:
        """The view's grey values."""
        return cv2.cvtColor(self.view, cv2.COLOR_RGB2GRAY)


class Aligner:
    """Finds points of the object, seen in a view, in a frame of the camera."""

    def __init__(self, pictures: Pictures, points: Points, camera: Camera, config: PnpConfig) -> None:
        levels = max(config.align_levels, 1)
        self._levels = config.align_levels
        self._view = ViewPoints.of(
            pictures.grey, pictures.depth, pictures.camera, pictures.cam_from_object, points, levels
        )
        grey = cv2.cvtColor(pictures.frame, cv2.COLOR_RGB2GRAY)
        self._frame = FramePyramid.of(grey, camera, max(pictures.grey.shape), levels)

    def rounds(self) -> Iterator[tuple[int, float]]:
        """Level, and largest error that would not surprise, in pixels of the frame, of each round: coarse to fine."""
        finest = FOUND_PX / float(self._frame.scale.min())
        for level in range(self._levels - 1, -1, -1):
            yield level, _LOOSER * finest * 2**level
        yield 0, finest

    def place(self, cam_from_object: Transform, level: int, most: int | None = None) -> Placed:
        """Look for the points, or `most` of them, near where a pose puts them; patches are 2^level pixels coarse."""
        at = warped(self._view, self._frame, cam_from_object)
        index = np.flatnonzero(at.seen)
        if most is not None:
            index = index[:: max(1, -(-len(index) // most))]
        return place(self._view, self._frame, at, level, index)
