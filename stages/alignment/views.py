"""Points of a rendered view, made ready once to be looked for in any number of frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fieldpose.stages.alignment.images import pyramid
from fieldpose.stages.geometry import Camera
from fieldpose.stages.geometry.arrays import Depth, Grey, Pixels, Pixels64, Points, Transform

_BASELINE_PX = 2
_NO_SURFACE = np.float32(1e3)


@dataclass(frozen=True)
class ViewPoints:
    """Points (n, 3) of the object and what the view shows around them.

    levels: the view's grey values; camera (undistorted) and cam_from_object are the view's.  pixels: (n, 2) there.
    inverse_depth: (n,), NaN for none; slopes (n, 2): its derivatives by the pixel.
    """

    levels: list[np.ndarray]
    camera: Camera
    cam_from_object: Transform
    points: Points
    pixels: Pixels64
    inverse_depth: np.ndarray
    slopes: np.ndarray

    @classmethod
    def of(
        cls, grey: Grey, depth: Depth, camera: Camera, cam_from_object: Transform, points: Points, levels: int
    ) -> ViewPoints:
        """Of a view's images (h, w), for points of the object that it shows."""
        in_view = points @ cam_from_object[:3, :3].T + cam_from_object[:3, 3]
        pixels = camera.project(in_view)
        near = np.where(in_view[:, 2] > 0, 1 / np.maximum(in_view[:, 2], 1e-9), np.nan)
        slopes = inverse_depth_slopes(depth, pixels).astype(np.float64)
        return cls(pyramid(grey, levels), camera, cam_from_object, points, pixels, near, slopes)


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
