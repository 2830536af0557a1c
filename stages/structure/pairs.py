"""Which of many photographs to match with each other: those that by their poses, or by their looks, show the same.

Source: Jégou and others, Aggregating local descriptors into a compact image representation (2010), for looks.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from fieldpose.stages.geometry import camera_centres
from fieldpose.stages.geometry.arrays import Transforms
from fieldpose.stages.structure.features import Keypoints, root

NEAREST = 8
"""Partners of an image that are nearest to it; a point is to be found in three images at least."""
FARTHER = 6
"""Partners besides, at ranks each so many times farther than the one before: they keep long chains from bending."""
_RANK_GROWTH = 1.5
_WORDS, _SAMPLE = 64, 20_000
"""Of which looks are told, and descriptors that these are chosen by."""
WIDEST_DEG = 60.0
"""Between the axes of partners: SIFT is good up to some 50 degrees between directions of view (Lowe, section 5)."""


def choose_pairs(cam_from_object: Transforms) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, sorted: for each image its nearest ones and some farther ones, all of them if they are few.

    How near is told by the angle between the axes, and by the distance of the centres as seen from where cameras are
    spread around; errors of poses of a few degrees change little of it.
    """
    cost = _apart(cam_from_object)
    ranks = _ranks(len(cam_from_object))
    pairs = set()
    for i, row in enumerate(cost):
        order = np.argsort(row, kind="stable")
        usable = order[np.isfinite(row[order])]
        pairs |= {(min(i, int(j)), max(i, int(j))) for j in usable[ranks[ranks < len(usable)]]}
    return sorted(pairs)


def _ranks(count: int) -> np.ndarray:
    farther = NEAREST * _RANK_GROWTH ** np.arange(1, FARTHER + 1)
    return np.unique(np.concatenate([np.arange(NEAREST), np.rint(farther).astype(int)]))


def _apart(cam_from_object: Transforms) -> np.ndarray:
    """(n, n): the greater the less two images share; infinite for an image and itself, and for axes too far apart."""
    axes, centres = cam_from_object[:, 2, :3], camera_centres(cam_from_object)
    angle = np.degrees(np.arccos(np.clip(axes @ axes.T, -1, 1)))
    distance = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    spread = float(np.median(np.linalg.norm(centres - np.median(centres, axis=0), axis=1)))
    cost = angle / WIDEST_DEG + distance / (2 * spread if spread > 0 else 1.0)
    cost[angle > WIDEST_DEG] = np.inf
    np.fill_diagonal(cost, np.inf)
    return cost


def alike_pairs(keypoints: Sequence[Keypoints], partners: int) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, sorted: for each image those that look most like it, by their descriptors."""
    if sum(map(len, keypoints)) < _WORDS:
        return []
    signatures = _signatures([root(found.descriptors) for found in keypoints])
    alike = signatures @ signatures.T
    np.fill_diagonal(alike, -np.inf)
    best = np.argsort(-alike, axis=1, kind="stable")[:, : min(partners, len(keypoints) - 1)]
    return sorted({(min(i, int(j)), max(i, int(j))) for i, row in enumerate(best) for j in row})


def _signatures(descriptors: Sequence[np.ndarray]) -> np.ndarray:
    """(n, words * 128), of length 1 each: how an image's descriptors differ from the words that are nearest to them."""
    everything = np.concatenate(descriptors)
    some = everything[np.random.default_rng(0).permutation(len(everything))[:_SAMPLE]]
    cv2.setRNGSeed(0)
    criteria = (cv2.TERM_CRITERIA_MAX_ITER | cv2.TERM_CRITERIA_EPS, 20, 1e-4)
    _, _, centres = cv2.kmeans(some, _WORDS, None, criteria, 1, cv2.KMEANS_PP_CENTERS)  # type: ignore[call-overload]
    result = np.zeros((len(descriptors), _WORDS, everything.shape[1]), np.float32)
    for signature, own in zip(result, descriptors, strict=True):
        nearest = (own @ centres.T - 0.5 * (centres**2).sum(axis=1)).argmax(axis=1)
        np.add.at(signature, nearest, own - centres[nearest])
    flat = result.reshape(len(descriptors), -1)
    flat = np.sign(flat) * np.sqrt(np.abs(flat))
    return flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
