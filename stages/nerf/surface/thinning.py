"""Points spread evenly: one in each cube of a grid."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

_TOGETHER = 16
_COARSEST = 2.0**12


def one_a_cube(parts: Iterable[tuple[np.ndarray, np.ndarray, np.ndarray]], spacing: float) -> np.ndarray:
    """Means (k, 6) float64 of points and of normals over cubes of a side of `spacing`, one row for each with any.

    parts: points (n, 3), normals (n, 3) and weights (n,) of each; no more than a few parts are held. The normals are
    not of unit length.
    """
    keys, sums = np.zeros((0, 3), np.int64), np.zeros((0, 7))
    waiting: list[tuple[np.ndarray, np.ndarray]] = []
    for points, normals, weights in parts:
        rows = np.concatenate([points, normals, np.ones((len(points), 1))], axis=1) * weights[:, None]
        waiting.append(_summed(np.floor(points / spacing).astype(np.int64), rows))
        if len(waiting) == _TOGETHER:
            keys, sums = _together([(keys, sums), *waiting])
            waiting = []
    keys, sums = _together([(keys, sums), *waiting])
    means: np.ndarray = sums[:, :6] / sums[:, 6:]
    return means


def thinned(points: np.ndarray, count: int, spacing: float, rng: np.random.Generator) -> np.ndarray:
    """Indices of `count` of points (n, 3), or of all where they are fewer: one a cube of the side that leaves enough.

    spacing: the side to begin with, at which points lie already.
    """
    if len(points) <= count:
        return np.arange(len(points))
    low, high = spacing, spacing * _COARSEST
    chosen = np.arange(len(points))
    for _ in range(16):
        middle = float(np.sqrt(low * high))
        _, first = np.unique(np.floor(points / middle).astype(np.int64), axis=0, return_index=True)
        if len(first) >= count:
            low, chosen = middle, first
        else:
            high = middle
    return np.sort(rng.permutation(chosen)[:count])


def _together(parts: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    return _summed(np.concatenate([keys for keys, _ in parts]), np.concatenate([sums for _, sums in parts]))


def _summed(keys: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each key once, with the sum of its rows."""
    low = keys.min(axis=0, initial=0)
    size = keys.max(axis=0, initial=0) - low + 1
    flat = np.ravel_multi_index(tuple((keys - low).T), tuple(size)) if len(keys) else np.zeros(0, np.int64)
    _, first, inverse = np.unique(flat, return_index=True, return_inverse=True)
    sums = np.stack([np.bincount(inverse, column, len(first)) for column in rows.T], axis=1)
    return keys[first], sums
