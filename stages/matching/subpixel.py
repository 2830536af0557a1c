"""Placing matches between pixels by aligning the small patches around them.

Source: Lucas and Kanade, An iterative image registration technique (1981), in OpenCV's implementation.
"""

from __future__ import annotations

import cv2
import numpy as np

_MAX_SHIFT_PX = 2.0
_UNALIGNED = 0.5
_CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 10, 0.02)


def align_patches(
    grey_a: np.ndarray, grey_b: np.ndarray, pixels_a: np.ndarray, pixels_b: np.ndarray, window: int
) -> tuple[np.ndarray, np.ndarray]:
    """Move pixels_b (n, 2) so that the patch around each looks like that around its pixels_a (n, 2), float32.

    grey_a, grey_b: (h, w) uint8, of any two sizes; window: the patch's side in pixels. Returns the pixels in b and
    what to multiply each match's confidence by: 1 where the patches were aligned, half that where no alignment was
    found within 2 pixels and the match stays where it was (it is then either wrong or imprecise).
    """
    if len(pixels_a) == 0:
        return pixels_b, np.ones(0, np.float32)
    height, width = np.maximum(grey_a.shape, grey_b.shape)
    first, second = _padded(grey_a, height, width), _padded(grey_b, height, width)
    moved, found, _ = cv2.calcOpticalFlowPyrLK(
        first, second, np.ascontiguousarray(pixels_a)[:, None], pixels_b[:, None].copy(),
        winSize=(window, window), maxLevel=0, criteria=_CRITERIA, flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    aligned = (found[:, 0] == 1) & (np.linalg.norm(moved[:, 0] - pixels_b, axis=1) < _MAX_SHIFT_PX)
    factor = np.where(aligned, 1.0, _UNALIGNED).astype(np.float32)
    return np.where(aligned[:, None], moved[:, 0], pixels_b), factor


def _padded(grey: np.ndarray, height: int, width: int) -> np.ndarray:
    """OpenCV wants two images of one size."""
    bottom, right = height - grey.shape[0], width - grey.shape[1]
    if bottom == right == 0:
        return grey
    return cv2.copyMakeBorder(grey, 0, bottom, 0, right, cv2.BORDER_REPLICATE)
