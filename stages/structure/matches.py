"""What two photographs share: descriptors matched, and of these what a fundamental matrix explains.

A fundamental matrix, since a focal length may be far from true: nothing of the given cameras decides what matches.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from threadpoolctl import threadpool_limits

from fieldpose.stages.structure.features import Keypoints, root

_RATIO = 0.8
"""Of the distances to the nearest descriptor and the second: nine of ten wrong matches have a greater one (Lowe)."""
_EPIPOLAR_PX = 3.0
"""A keypoint is good to about one pixel of its octave, and the lens distorts."""
_FEWEST = 20
"""Of a pair: seven points make a matrix, so that fewer are soon explained by chance."""
_CONFIDENCE = 0.9999
_MOST_TRIALS = 2000


def match_pairs(
    keypoints: Sequence[Keypoints],
    pairs: Sequence[tuple[int, int]],
    threads: int,
    report: Callable[[float], None] = lambda share: None,
) -> list[np.ndarray]:
    """For each pair the indices (n, 2) of keypoints in both images that show the same; none where too few agree.

    report: is told the share of the pairs that is done.
    """

    def matched(pair: tuple[int, int]) -> np.ndarray:
        first, second = keypoints[pair[0]], keypoints[pair[1]]
        return _verified(first, second, _mutual(root(first.descriptors), root(second.descriptors)))

    found = []
    with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(threads) as pool:
        for matches in pool.map(matched, pairs):
            found.append(matches)
            report(len(found) / len(pairs))
    return found


def _mutual(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Indices (n, 2) of mutual nearest descriptors whose second nearest is much farther."""
    if min(len(first), len(second)) < 2:
        return np.zeros((0, 2), np.int64)
    alike = first @ second.T
    rows = np.arange(len(first))
    best, back = alike.argmax(axis=1), alike.argmax(axis=0)
    nearest = np.sqrt(np.maximum(2 - 2 * alike[rows, best], 0))
    alike[rows, best] = -1
    second_nearest = np.sqrt(np.maximum(2 - 2 * alike.max(axis=1), 0))
    good = (back[best] == rows) & (nearest < _RATIO * second_nearest)
    return np.stack([rows[good], best[good]], axis=1)


def _verified(first: Keypoints, second: Keypoints, matches: np.ndarray) -> np.ndarray:
    import pycolmap

    none = np.zeros((0, 2), np.int64)
    if len(matches) < _FEWEST:
        return none
    options = pycolmap.RANSACOptions(
        max_error=_EPIPOLAR_PX, confidence=_CONFIDENCE, max_num_trials=_MOST_TRIALS, random_seed=0
    )
    found = pycolmap.estimate_fundamental_matrix(first.pixels[matches[:, 0]], second.pixels[matches[:, 1]], options)
    if found is None or found["num_inliers"] < _FEWEST:
        return none
    return matches[found["inlier_mask"]]
