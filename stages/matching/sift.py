"""SIFT keypoints with RootSIFT descriptors: no network and no weights.

Sources: Lowe, Distinctive image features from scale-invariant keypoints (2004), with its ratio test; Arandjelović
and Zisserman, Three things everyone should know to improve object retrieval (2012), for the square root.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import torch

from fieldpose.stages.matching.core import Features, MatchedPixels, MatchingConfig
from fieldpose.stages.matching.xfeat import mutual_nearest

_MAX_RATIO = 0.85
_CONTRAST = 0.02


class SiftMatcher:
    """Mutual nearest neighbours that pass the ratio test; confidence is 1 minus the ratio of distances."""

    placed_between_pixels = True

    def __init__(self, config: MatchingConfig) -> None:
        create: Any = cv2.SIFT_create  # type: ignore[attr-defined]  # missing from OpenCV's stubs
        self._sift = create(nfeatures=config.max_keypoints, contrastThreshold=_CONTRAST)
        self._min_confidence = 1 - _MAX_RATIO if config.min_confidence is None else config.min_confidence

    def extract(self, image: np.ndarray, mask: np.ndarray | None = None) -> Features:
        """Features of an image (h, w, 3) uint8 where mask (h, w) bool is true."""
        allowed = None if mask is None else mask.astype(np.uint8)
        keypoints, descriptors = self._sift.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), allowed)
        pixels = np.array([keypoint.pt for keypoint in keypoints], np.float32).reshape(-1, 2)
        if descriptors is None:
            descriptors = np.zeros((0, 128), np.float32)
        root = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9))
        return Features(pixels, (image.shape[1], image.shape[0]), torch.from_numpy(root))

    def match(self, view: Features, frame: Features) -> MatchedPixels:
        """Mutual nearest neighbours among the descriptors of two images whose second nearest is much farther."""
        in_view, in_frame, _ = mutual_nearest(view.data, frame.data)
        confidence = 1 - _distance_ratio(view.data[in_view], frame.data)
        good = confidence >= self._min_confidence
        return MatchedPixels(view.pixels[in_view[good]], frame.pixels[in_frame[good]], confidence[good])


def _distance_ratio(descriptors: torch.Tensor, others: torch.Tensor) -> np.ndarray:
    """Distance to the nearest of the others over that to the second, (n,) float32; 0 if there is but one."""
    if len(others) < 2 or len(descriptors) == 0:
        return np.zeros(len(descriptors), np.float32)
    distances = torch.sqrt((2 - 2 * torch.topk(descriptors @ others.T, 2).values).clamp_min(1e-12))
    return (distances[:, 0] / distances[:, 1]).numpy()
