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
from jaxtyping import Bool, Float

from fieldpose.stages.geometry import Camera, inverse, unscale_pixels
from fieldpose.stages.geometry.arrays import (
    Depth,
    FrameImage,
    Grey,
    Image,
    Indices,
    Matrices2,
    Pixels,
    Pixels64,
    Points,
    Transform,
)
from fieldpose.stages.images import shrunk_with_camera
from fieldpose.stages.pnp import constants
from fieldpose.stages.pnp.config import PnpConfig
from fieldpose.stages.pnp.least_squares import intrinsics_of
from fieldpose.stages.pnp.patches import find_patches
from fieldpose.stages.pnp.warps import warp_patches

_PER_LEVEL_OF_GREY = np.float32(1 / 255)
_LOOSER = 1.4
"""Errors before a round are larger than after the last by this and by how coarse the round is."""
_BASELINE_PX = 2
_NO_SURFACE = np.float32(1e3)


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


@dataclass(frozen=True)
class Placed:
    """Points that were found in the frame: which, their pixels, and how exact these are.

    weights: their inverse covariances up to a factor: an edge's patch tells nothing of where it is along it.
    seen: which of all points the pose puts into the frame.
    """

    index: Indices
    pixels: Pixels64
    weights: Matrices2
    seen: Bool[np.ndarray, " points"]


class Aligner:
    """Finds points of the object, seen in a view, in a frame of the camera."""

    def __init__(self, pictures: Pictures, points: Points, camera: Camera, config: PnpConfig) -> None:
        self._view_camera, self._view_pose, self._config = pictures.camera, pictures.cam_from_object, config
        grey = cv2.cvtColor(pictures.frame, cv2.COLOR_RGB2GRAY)
        frame, self._camera = shrunk_with_camera(grey, camera, max(pictures.grey.shape))
        levels = max(config.align_levels, 1)
        self._view, self._frame = _pyramid(pictures.grey, levels), _pyramid(frame, levels)
        self._scale = np.array([self._camera.width / camera.width, self._camera.height / camera.height])
        in_view = points @ self._view_pose[:3, :3].T + self._view_pose[:3, 3]
        self._pixels = self._view_camera.project(in_view)
        self._inverse_depth = np.where(in_view[:, 2] > 0, 1 / np.maximum(in_view[:, 2], 1e-9), np.nan)
        self._slopes = inverse_depth_slopes(pictures.depth, self._pixels).astype(np.float64)

    def rounds(self) -> Iterator[tuple[int, float]]:
        """Level, and largest error that would not surprise, in pixels of the frame, of each round: coarse to fine."""
        finest = constants.ALIGN_PX / float(self._scale.min())
        for level in range(self._config.align_levels - 1, -1, -1):
            yield level, _LOOSER * finest * 2**level
        yield 0, finest

    def place(self, cam_from_object: Transform, level: int, most: int | None = None) -> Placed:
        """Look for the points, or `most` of them, near where a pose puts them; patches are 2^level pixels coarse."""
        smaller = np.float32(0.5**level)
        width, height, count = self._camera.width, self._camera.height, len(self._pixels)
        starts, warps = np.empty((count, 2), np.float32), np.empty((count, 2, 2), np.float32)
        seen = np.empty(count, bool)
        warp_patches(
            self._pixels, self._inverse_depth, self._slopes, intrinsics_of(self._view_camera),
            cam_from_object @ inverse(self._view_pose), intrinsics_of(self._camera),
            np.array(self._camera.distortion), (width, height), starts, warps, seen,
        )  # fmt: skip
        index = np.flatnonzero(seen)
        if most is not None:
            index = index[:: max(1, -(-len(index) // most))]
        places, similarity = np.empty((len(index), 2), np.float32), np.empty(len(index), np.float32)
        covariance = np.empty((len(index), 2, 2), np.float32)
        find_patches(
            self._view[level], self._frame[level], (self._pixels[index] * smaller).astype(np.float32), warps[index],
            starts[index] * smaller, constants.ALIGN_HALF, constants.ALIGN_STEPS, places, similarity, covariance,
        )  # fmt: skip
        places /= smaller
        inside = ((places >= 0) & (places <= (width - 1, height - 1))).all(axis=1)
        found = inside & (similarity > constants.ALIGN_SIMILARITY)
        pixels = unscale_pixels(places[found].astype(np.float64), self._scale)
        # In pixels of the view, of which the frame's are all the same multiple.
        covariance = covariance[found].astype(np.float64) * 4**level
        return Placed(index[found], pixels, np.linalg.inv(covariance + constants.ALIGN_FLOOR_PX**2 * np.eye(2)), seen)


def inverse_depth_slopes(depth: Float[np.ndarray, "h w"], pixels: Pixels) -> Float[np.ndarray, "n 2"]:
    """Derivatives of the inverse depth by the pixel at pixels of a depth image, 0 for no surface.

    Of the differences to either side the smaller one counts, which does not reach over an edge.
    """
    height, width = depth.shape
    x, y = np.clip(np.rint(np.nan_to_num(pixels)), 0, (width - 1, height - 1)).astype(int).T
    here = _inverse(depth[y, x])
    slopes = []
    for dx, dy in ((_BASELINE_PX, 0), (0, _BASELINE_PX)):
        sides = []
        for sign in (-1, 1):
            column, row = x + sign * dx, y + sign * dy
            inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
            there = _inverse(depth[np.where(inside, row, y), np.where(inside, column, x)])
            usable = inside & (here > 0) & (there > 0)
            sides.append(np.where(usable, sign * (there - here) / _BASELINE_PX, _NO_SURFACE))
        smaller = np.where(np.abs(sides[0]) <= np.abs(sides[1]), sides[0], sides[1])
        slopes.append(np.where(np.abs(smaller) < _NO_SURFACE, smaller, 0))
    return np.stack(slopes, axis=1)


def _inverse(depth: np.ndarray) -> np.ndarray:
    return np.where(depth > 0, 1 / np.maximum(depth, 1e-9), 0)


def _pyramid(grey: np.ndarray, levels: int) -> list[np.ndarray]:
    """The image as float32 in 0..1, then each half as large as the one before, whose pixel 2 x is its pixel x."""
    images: list[np.ndarray] = [grey.astype(np.float32) * _PER_LEVEL_OF_GREY]
    while len(images) < levels:
        images.append(cv2.pyrDown(images[-1]))
    return images
