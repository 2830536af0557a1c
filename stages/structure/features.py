"""Points of photographs that are found again in others: SIFT keypoints with RootSIFT descriptors.

Sources: Lowe, Distinctive image features from scale-invariant keypoints (2004); Arandjelović and Zisserman, Three
things everyone should know to improve object retrieval (2012), for the square root.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from fieldpose.stages.geometry.arrays import Pixels64

_CONTRAST = 0.02
"""Half of OpenCV's own, so that plain rooms have features too; the strongest are kept all the same."""
_LARGEST_PX = 12.0
"""Of a keypoint's diameter: on photographs of known cameras larger ones are placed three times less exactly than small
ones, and outnumber none."""
_INSIDE_PX = 5
"""From an object's outline: what a keypoint nearer to it shows is partly the background, which moves otherwise."""


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Of one image: pixels (n, 2), descriptors (n, 128) uint8."""

    pixels: Pixels64
    descriptors: np.ndarray

    def __len__(self) -> int:
        return len(self.pixels)


def find_keypoints(image: np.ndarray, most: int) -> Keypoints:
    """The strongest keypoints of an image (h, w, 3) uint8, or within the alpha channel of one (h, w, 4)."""
    grey = cv2.cvtColor(np.ascontiguousarray(image[..., :3]), cv2.COLOR_RGB2GRAY)
    create: Any = cv2.SIFT_create  # type: ignore[attr-defined]  # missing from OpenCV's stubs
    found, descriptors = create(contrastThreshold=_CONTRAST).detectAndCompute(grey, _inside(image))
    if descriptors is None:
        return Keypoints(np.zeros((0, 2)), np.zeros((0, 128), np.uint8))
    small = np.flatnonzero(np.array([keypoint.size for keypoint in found]) <= _LARGEST_PX)
    strength = np.array([found[i].response for i in small])
    chosen = small[np.argsort(-strength, kind="stable")[:most]]
    pixels = np.array([found[i].pt for i in chosen], np.float64).reshape(-1, 2)
    return Keypoints(pixels, descriptors[chosen].astype(np.uint8))


def root(descriptors: np.ndarray) -> np.ndarray:
    """RootSIFT (n, 128) float32 of length 1, whose distances are those of the histograms that SIFT has."""
    parts = descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True, dtype=np.float32), 1.0)
    return np.sqrt(parts, dtype=np.float32)


def _inside(image: np.ndarray) -> np.ndarray | None:
    if image.shape[2] == 3:
        return None
    side = 2 * _INSIDE_PX + 1
    return cv2.erode((image[..., 3] > 127).astype(np.uint8), np.ones((side, side), np.uint8))
