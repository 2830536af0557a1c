"""Which training views look most like a frame: where to begin when nothing is known of the camera.

A training view is remembered by the descriptors of its strongest keypoints. It resembles a frame by how well each of
them is found there; nothing is clustered or learnt, so that a field carries all that it takes.
Source: Boiman, Shechtman and Irani, In defense of nearest-neighbor based image classification (2008), for the
distance from an image's descriptors to their nearest in another.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from stages.matching.core import MatchingConfig, shrink
from stages.nerf.field import DESCRIPTOR_SIZE
from stages.retrieval.config import RetrievalConfig

__all__ = ["Describe", "Ranking", "RetrievalConfig", "Retriever", "describer", "remembered"]

_REMEMBERED = 128
_UNIT = 127.0
_AT_ONCE = 8
"""Views whose similarities are held at once: few enough for the caches."""

Describe = Callable[[np.ndarray], np.ndarray]
"""An image (h, w, 3) uint8 -> its strongest keypoints' unit descriptors (n, 64) float32, the strongest first."""


@dataclass(frozen=True)
class Ranking:
    """index: (m,) of the training views, the most alike first.  similarity: (m,) float32, 0 to 1."""

    index: np.ndarray
    similarity: np.ndarray


class Retriever:
    """Compares frames with training views, of which it is given the descriptors (views, keypoints, 64) int8."""

    def __init__(self, descriptors: np.ndarray, config: RetrievalConfig | None = None) -> None:
        self._config = config or RetrievalConfig()
        self._views = np.ascontiguousarray(descriptors, np.float32) / _UNIT

    def rank(self, frame: np.ndarray) -> Ranking:
        """The training views that resemble a frame by its descriptors (n, 64), as many as the configuration says."""
        frame = np.ascontiguousarray(frame[: self._config.keypoints], np.float32)
        similarity = np.zeros(len(self._views), np.float32)
        for first in range(0, len(self._views) if len(frame) else 0, _AT_ONCE):
            some = self._views[first : first + _AT_ONCE]
            nearest = (frame @ some.reshape(-1, DESCRIPTOR_SIZE).T).max(axis=0).reshape(some.shape[:2])
            similarity[first : first + _AT_ONCE] = _share_above(nearest, self._config.min_cosine)
        index = np.argsort(-similarity, kind="stable")[: self._config.candidates]
        index = index[similarity[index] > 0]
        return Ranking(index, similarity[index])


def describer(matching: MatchingConfig, longer_side: int, keypoints: int = _REMEMBERED) -> Describe:
    """Describes images, no larger than `longer_side`, by XFeat, whatever the matcher is. Raises WeightsError."""
    from stages.matching.xfeat import XFeatExtractor

    weights = matching.weights if matching.matcher.startswith("xfeat") else None
    extractor = XFeatExtractor(
        MatchingConfig(
            max_keypoints=keypoints, weights=weights, allow_download=matching.allow_download, device=matching.device
        )
    )

    def describe(image: np.ndarray) -> np.ndarray:
        features = extractor.extract(shrink(image, longer_side)[0])
        descriptors: np.ndarray = features.data.cpu().numpy()
        return descriptors

    return describe


def remembered(descriptors: Iterable[np.ndarray]) -> np.ndarray:
    """What a field keeps of its training views: of each (n, 64) the first, in (views, keypoints, 64) int8."""
    views = []
    for described in descriptors:
        strongest, view = described[:_REMEMBERED], np.zeros((_REMEMBERED, DESCRIPTOR_SIZE), np.int8)
        view[: len(strongest)] = np.rint(_UNIT * np.clip(strongest, -1, 1))
        views.append(view)
    return np.array(views, np.int8).reshape(-1, _REMEMBERED, DESCRIPTOR_SIZE)


def _share_above(cosines: np.ndarray, least: float) -> np.ndarray:
    """By how much cosines (views, keypoints) exceed the least, on average, as a share of how much they might."""
    above: np.ndarray = np.maximum(cosines - least, 0).mean(axis=1) / max(1 - least, 1e-6)
    return np.minimum(above, 1)
