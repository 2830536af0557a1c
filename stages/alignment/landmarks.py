"""Points of a view that are easily found again in a frame, whatever was matched.

Source: Shi and Tomasi, Good features to track (1994).
"""

from __future__ import annotations

import cv2
import numpy as np

from fieldpose.stages.geometry import Camera, points_at_depth
from fieldpose.stages.geometry.arrays import Depth, Grey, Pixels32, Points64, Transform

_LEAST_QUALITY = 0.01
_APART_PX = 4
_WINDOW_PX = 5
_LARGEST_STEP = 0.1
_AROUND = np.ones((3, 3), np.uint8)


def landmarks(grey: Grey, depth: Depth, camera: Camera, cam_from_object: Transform, most: int) -> Points64:
    """Points of the object, at most so many: those whose surroundings in the view have the most texture, best first.

    Grey values, depth and camera are the view's.
    None is taken where the depth steps between neighbours by a tenth or more, as it does where the object ends.
    """
    pixels = _corners(grey, depth, most)
    column, row = pixels.astype(int).T
    points = points_at_depth(camera, cam_from_object, pixels, depth[row, column])
    return points.astype(np.float64)


def _corners(grey: Grey, depth: Depth, most: int) -> Pixels32:
    """Pixels, whole numbers, the best ones first."""
    left, top, width, height = cv2.boundingRect((depth > 0).astype(np.uint8))
    if most == 0 or min(width, height) < _WINDOW_PX:
        return np.zeros((0, 2), np.float32)
    shown = slice(top, top + height), slice(left, left + width)
    found = cv2.goodFeaturesToTrack(
        grey[shown], most, _LEAST_QUALITY, _APART_PX, mask=_continuous(depth[shown]), blockSize=_WINDOW_PX
    )
    if found is None:
        return np.zeros((0, 2), np.float32)
    pixels: np.ndarray = found[:, 0] + np.array([left, top], np.float32)
    return pixels


def _continuous(depth: Depth) -> Grey:
    """1 where the eight pixels around show the same surface, 0 elsewhere."""
    nearest, farthest = cv2.erode(depth, _AROUND), cv2.dilate(depth, _AROUND)
    continuous: np.ndarray = (nearest > 0) & (farthest - nearest < _LARGEST_STEP * farthest)
    return continuous.astype(np.uint8)
