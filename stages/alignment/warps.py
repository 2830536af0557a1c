"""Where points of a view are in a frame at a supposed pose, and how the patches around them are warped there."""

from __future__ import annotations

import numpy as np
from numba import njit

from fieldpose.stages.kernel_cache import cached_njit

_AROUND = np.array([[0.0, 0.0], [-0.5, 0.0], [0.5, 0.0], [0.0, -0.5], [0.0, 0.5]])
"""From a pixel to itself, and to half a pixel left, right, above and below."""
_FLATTEST, _STEEPEST = 0.15, 6.0
"""Patches that cover less or more of the frame than these shares of themselves are seen too differently."""
_AHEAD = 1e-6


@njit(inline="always")
def _distorted(x: float, y: float, distortion: np.ndarray) -> tuple[float, float]:
    """As `distort` of stages.geometry."""
    k1, k2, p1, p2, k3 = distortion
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y


@cached_njit(nogil=True)
def warp_patches(
    pixels: np.ndarray, inverse_depth: np.ndarray, slopes: np.ndarray, view: np.ndarray, frame_from_view: np.ndarray,
    frame: np.ndarray, distortion: np.ndarray, size: tuple[int, int], places: np.ndarray, view_from_frame: np.ndarray,
    seen: np.ndarray,
) -> None:  # fmt: skip
    """Fill places (n, 2), view_from_frame (n, 2, 2), both float32, and seen (n,) bool.

    pixels: (n, 2) of the view.  inverse_depth: (n,) there, NaN where there is none, and its derivatives by the pixel,
    slopes (n, 2): a surface is taken to be its tangent plane.  view, frame: fx, fy, cx and cy of each.
    frame_from_view: (4, 4).  distortion: (5,), of the frame.  All these float64.  size: the frame's width and height.
    places are the pixels of the frame; view_from_frame is how small offsets from there become offsets in the view;
    seen is whether the point is in the frame, ahead of the camera, and the patch neither too flat nor too steep.
    """
    right, bottom = size[0] - 1.0, size[1] - 1.0
    around = np.empty((5, 2))
    for i in range(pixels.shape[0]):
        seen[i] = True
        for k in range(5):
            dx, dy = _AROUND[k]
            u, v = (pixels[i, 0] + dx - view[2]) / view[0], (pixels[i, 1] + dy - view[3]) / view[1]
            # A plane's inverse depth is linear in the pixel; points scaled by it project to the same pixels.
            near = inverse_depth[i] + slopes[i, 0] * dx + slopes[i, 1] * dy
            x = frame_from_view[0, 0] * u + frame_from_view[0, 1] * v + frame_from_view[0, 2]
            y = frame_from_view[1, 0] * u + frame_from_view[1, 1] * v + frame_from_view[1, 2]
            z = frame_from_view[2, 0] * u + frame_from_view[2, 1] * v + frame_from_view[2, 2]
            x += near * frame_from_view[0, 3]
            y += near * frame_from_view[1, 3]
            z += near * frame_from_view[2, 3]
            if not z > _AHEAD:
                seen[i] = False
                break
            x, y = _distorted(x / z, y / z, distortion)
            around[k, 0], around[k, 1] = frame[0] * x + frame[2], frame[1] * y + frame[3]
        if not seen[i]:
            continue
        a, b = around[2, 0] - around[1, 0], around[4, 0] - around[3, 0]
        c, d = around[2, 1] - around[1, 1], around[4, 1] - around[3, 1]
        determinant = a * d - b * c
        x, y = around[0]
        inside = 0 <= x <= right and 0 <= y <= bottom
        if not (inside and _FLATTEST < determinant < _STEEPEST):
            seen[i] = False
            continue
        places[i, 0], places[i, 1] = x, y
        view_from_frame[i, 0, 0], view_from_frame[i, 0, 1] = d / determinant, -b / determinant
        view_from_frame[i, 1, 0], view_from_frame[i, 1, 1] = -c / determinant, a / determinant
