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
from jaxtyping import Float32, Int8

from fieldpose.stages.geometry.arrays import Image, Indices, Values32
from fieldpose.stages.images import shrunk
from fieldpose.stages.matching.core import MatchingConfig
from fieldpose.stages.nerf.field import DESCRIPTOR_SIZE
from fieldpose.stages.retrieval.config import RetrievalConfig

__all__ = ["Describe", "Ranking", "RetrievalConfig", "Retriever", "describer", "remembered"]

_REMEMBERED = 128
_UNIT = 127.0
_AT_ONCE = 1024
"""Keypoints of views whose similarities are held at once: few enough for the caches."""
_ROUGH, _LIKELY = 32, 32
"""So many keypoints of each view tell which views, so many at least, are worth a look at all of theirs."""

Descriptors = Float32[np.ndarray, "_ 64"]
Memory = Int8[np.ndarray, "views keypoints 64"]
Describe = Callable[[Image], Descriptors]
"""An image -> its strongest keypoints' unit descriptors, the strongest first."""


@dataclass(frozen=True)
class Ranking:
    """index: of the training views, the most alike first.  similarity: 0 to 1."""

    index: Indices
    similarity: Values32


class Retriever:
    """Compares frames with training views, of which it is given the descriptors."""

    def __init__(self, descriptors: Memory, config: RetrievalConfig | None = None) -> None:
        self._config = config or RetrievalConfig()
        self._views = np.ascontiguousarray(descriptors, np.float32) / _UNIT
        self._rough = np.ascontiguousarray(self._views[:, :_ROUGH])

    def rank(self, frame: Descriptors) -> Ranking:
        """The training views that resemble a frame by its descriptors, as many as the configuration says."""
        candidates, frame = self._config.candidates, np.ascontiguousarray(frame[: self._config.keypoints], np.float32)
        if len(frame) == 0:
            return Ranking(np.zeros(0, np.int64), np.zeros(0, np.float32))
        likely = _best_first(self._similarity(self._rough, frame))[: max(2 * candidates, _LIKELY)]
        similarity = self._similarity(self._views[likely], frame)
        best = _best_first(similarity)[:candidates]
        best = best[similarity[best] > 0]
        return Ranking(likely[best], similarity[best])

    def _similarity(
        self, views: Float32[np.ndarray, "views keypoints 64"], frame: Descriptors
    ) -> Float32[np.ndarray, " views"]:
        """Of views to a frame."""
        similarity = np.empty(len(views), np.float32)
        at_once = max(1, _AT_ONCE // max(1, views.shape[1]))
        for first in range(0, len(views), at_once):
            some = views[first : first + at_once]
            nearest = (frame @ some.reshape(-1, DESCRIPTOR_SIZE).T).max(axis=0).reshape(some.shape[:2])
            similarity[first : first + at_once] = _share_above(nearest, self._config.min_cosine)
        return similarity


def describer(matching: MatchingConfig, longer_side: int, keypoints: int = _REMEMBERED) -> Describe:
    """Describes images, no larger than `longer_side`, by XFeat, whatever the matcher is. Raises WeightsError."""
    from fieldpose.stages.matching.xfeat import XFeatExtractor

    weights = matching.weights if matching.matcher.startswith("xfeat") else None
    extractor = XFeatExtractor(
        MatchingConfig(
            max_keypoints=keypoints, weights=weights, allow_download=matching.allow_download, device=matching.device
        )
    )

    def describe(image: Image) -> Descriptors:
        features = extractor.extract(shrunk(image, longer_side))
        descriptors: Descriptors = features.data.cpu().numpy()
        return descriptors

    return describe


def remembered(descriptors: Iterable[Descriptors]) -> Memory:
    """What a field keeps of its training views: of each the first."""
    views = []
    for described in descriptors:
        strongest, view = described[:_REMEMBERED], np.zeros((_REMEMBERED, DESCRIPTOR_SIZE), np.int8)
        view[: len(strongest)] = np.rint(_UNIT * np.clip(strongest, -1, 1))
        views.append(view)
    return np.array(views, np.int8).reshape(-1, _REMEMBERED, DESCRIPTOR_SIZE)


def _best_first(similarity: np.ndarray) -> np.ndarray:
    return np.argsort(-similarity, kind="stable")


def _share_above(cosines: np.ndarray, least: float) -> np.ndarray:
    """By how much cosines (views, keypoints) exceed the least, on average, as a share of how much they might."""
    above: np.ndarray = np.maximum(cosines - least, 0).mean(axis=1) / max(1 - least, 1e-6)
    return np.minimum(above, 1)
