"""Triangles and points of a surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class SurfacePoints:
    """Points (n, 3) float32 with unit normals (n, 3) float32 and colours (n, 3) uint8 sRGB, in object coordinates."""

    points: np.ndarray
    normals: np.ndarray
    colours: np.ndarray

    def kept(self, which: np.ndarray) -> SurfacePoints:
        """Some of them, by (n,) bool or indices."""
        return SurfacePoints(self.points[which], self.normals[which], self.colours[which])


@dataclass(frozen=True)
class SurfaceMesh(SurfacePoints):
    """And triangles (m, 3) int32 of rows of the points, counterclockwise as seen from outside."""

    triangles: np.ndarray


def areas(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Of each triangle, (m,)."""
    half: np.ndarray = np.linalg.norm(_cross(points, triangles), axis=1) / 2
    return half


def vertex_normals(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Unit normals (n, 3) float32: of each point the mean over its triangles, by their areas; z where that is none."""
    cross = _cross(points, triangles)
    total = np.stack(
        [np.bincount(triangles.ravel(), np.repeat(cross[:, k], 3), len(points)) for k in range(3)], axis=1
    )  # fmt: skip
    length = np.linalg.norm(total, axis=1, keepdims=True)
    upright = np.tile((0.0, 0.0, 1.0), (len(points), 1))
    return np.divide(total, length, out=upright, where=length > 0).astype(np.float32)


def pieces_of_share(points: np.ndarray, triangles: np.ndarray, least: float) -> np.ndarray:
    """(m,) bool: triangles of pieces, joined by points, whose area is at least `least` of the largest piece's."""
    # It takes a quarter of a second to import.
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    if not len(triangles):
        return np.zeros(0, bool)
    a, b, c = triangles.T
    ends = (np.concatenate([a, b]), np.concatenate([b, c]))
    graph = coo_array((np.ones(len(ends[0]), bool), ends), shape=(len(points), len(points)))
    _, piece = connected_components(graph, directed=False)
    area = np.bincount(piece[a], areas(points, triangles))
    large: np.ndarray = (area >= least * area.max())[piece[a]]
    return large


def without_unused(triangles: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Which of `count` points triangles use, (k,) in order, and the triangles (m, 3) int32 by these."""
    used = np.zeros(count, bool)
    used[triangles] = True
    renamed = np.cumsum(used, dtype=np.int32) - 1
    return np.flatnonzero(used), renamed[triangles]


def _cross(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    a, b, c = (points[triangles[:, k]] for k in range(3))
    return np.cross(b - a, c - a)
