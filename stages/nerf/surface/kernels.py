"""What views of depth say of points of space: compiled loops over many points and views."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from fieldpose.stages.kernel_cache import cached_njit

NEAREST = np.float32(1e-6)
HALF, ONE = np.float32(0.5), np.float32(1)


class DepthViews(NamedTuple):
    """Rendered views of pinhole cameras, in arrays as large as the largest of them.

    depth is along the optical axis: 0 where it is not known, infinite where nothing is seen. facing: the cosine between
    the surface's normal and the way to the camera, times 255. turn and shift take object to camera coordinates.
    """

    size: np.ndarray  # (v, 2) int64, width and height
    lens: np.ndarray  # (v, 4) float32, fx fy cx cy
    turn: np.ndarray  # (v, 3, 3) float32
    shift: np.ndarray  # (v, 3) float32
    depth: np.ndarray  # (v, h, w) float32
    facing: np.ndarray  # (v, h, w) uint8
    rgb: np.ndarray  # (v, h, w, 3) uint8


@njit(inline="always")
def depth_at(depth: np.ndarray, column: float, row: float, width: int, height: int, jump: float) -> tuple[float, float]:
    """Depth between pixels, and the least of the four around: linear where they differ by less than `jump`.

    Else it is the depth of the nearest pixel.
    """
    c0, r0 = max(min(int(column), width - 2), 0), max(min(int(row), height - 2), 0)
    a, b = depth[r0, c0], depth[r0, c0 + 1]
    c, d = depth[r0 + 1, c0], depth[r0 + 1, c0 + 1]
    least, most = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
    if least > 0 and most - least < jump:
        x, y = column - np.float32(c0), row - np.float32(r0)
        return (a * (ONE - x) + b * x) * (ONE - y) + (c * (ONE - x) + d * x) * y, least
    return depth[int(row + HALF), int(column + HALF)], least


@njit(inline="always")
def in_image(column: float, row: float, width: int, height: int) -> bool:
    """Whether a place lies on one of the pixels."""
    right, bottom = np.float32(width) - HALF, np.float32(height) - HALF
    return column > -HALF and row > -HALF and column < right and row < bottom


@njit(nogil=True)
def in_sight(views: DepthViews, v: int, centre: np.ndarray, radius: float) -> bool:
    """False where no point of a ball can be in a view's image."""
    turn, shift = views.turn[v], views.shift[v]
    z = turn[2, 0] * centre[0] + turn[2, 1] * centre[1] + turn[2, 2] * centre[2] + shift[2]
    if z + radius <= 0:
        return False
    if z <= radius:
        return True
    for axis in range(2):
        p = turn[axis, 0] * centre[0] + turn[axis, 1] * centre[1] + turn[axis, 2] * centre[2] + shift[axis]
        f, middle, end = views.lens[v, axis], views.lens[v, 2 + axis], views.size[v, axis]
        ends = ((p - radius) / (z - radius), (p - radius) / (z + radius))
        other = ((p + radius) / (z - radius), (p + radius) / (z + radius))
        if f * max(other[0], other[1]) + middle < -1 or f * min(ends[0], ends[1]) + middle > end:
            return False
    return True


@cached_njit(nogil=True)
def fuse(
    views: DepthViews,
    starts: np.ndarray,
    origin: np.ndarray,
    cell: float,
    reach: float,
    value: np.ndarray,
    weight: np.ndarray,
) -> None:
    """Fill value and weight (b, n, n, n) float32 with the truncated signed distance at nodes of blocks of a grid.

    starts (b, 3) int64: x, y, z of a block's first node; a node i is at origin + cell * i. Distances are positive
    before the surface, in units of `reach`, up to 1. A node has the same value in every block that it belongs to.
    """
    n = value.shape[1]
    radius = np.float32(0.87) * cell * (n - 1)
    centre = np.empty(3, np.float32)
    for b in range(starts.shape[0]):
        value[b], weight[b] = 0, 0
        for axis in range(3):
            centre[axis] = origin[axis] + cell * (starts[b, axis] + HALF * (n - 1))
        for v in range(views.depth.shape[0]):
            if in_sight(views, v, centre, radius):
                _add_view(views, v, starts[b], origin, cell, reach, value[b], weight[b])
        for k in range(n):
            for j in range(n):
                for i in range(n):
                    if weight[b, k, j, i] > 0:
                        value[b, k, j, i] /= weight[b, k, j, i]


@njit(nogil=True)
def _add_view(
    views: DepthViews,
    v: int,
    start: np.ndarray,
    origin: np.ndarray,
    cell: float,
    reach: float,
    value: np.ndarray,
    weight: np.ndarray,
) -> None:
    n = value.shape[0]
    turn, shift, depth, facing = views.turn[v], views.shift[v], views.depth[v], views.facing[v]
    fx, fy, cx, cy = views.lens[v]
    width, height = views.size[v]
    for k in range(n):
        z = origin[2] + cell * np.float32(start[2] + k)
        for j in range(n):
            y = origin[1] + cell * np.float32(start[1] + j)
            a0 = turn[0, 1] * y + turn[0, 2] * z + shift[0]
            a1 = turn[1, 1] * y + turn[1, 2] * z + shift[1]
            a2 = turn[2, 1] * y + turn[2, 2] * z + shift[2]
            for i in range(n):
                x = origin[0] + cell * np.float32(start[0] + i)
                p2 = turn[2, 0] * x + a2
                if p2 <= NEAREST:
                    continue
                s, t = (turn[0, 0] * x + a0) / p2, (turn[1, 0] * x + a1) / p2
                column, row = fx * s + cx, fy * t + cy
                if not in_image(column, row, width, height):
                    continue
                seen, least = depth_at(depth, column, row, width, height, reach)
                if seen <= 0:
                    continue
                cosine = np.float32(facing[int(row + HALF), int(column + HALF)]) * np.float32(1 / 255)
                distance = (seen - p2) * cosine * np.float32(math.sqrt(ONE + s * s + t * t)) / reach
                # Past an outline that is less than a pixel away nothing is sure: thin parts would be worn away.
                if distance <= -ONE or (distance > ONE and least < p2 + reach):
                    continue
                w = cosine * cosine / (p2 * p2)
                if distance < 0:
                    w *= ONE + distance
                value[k, j, i] += w * min(distance, ONE)
                weight[k, j, i] += w


@cached_njit(nogil=True)
def look(
    views: DepthViews,
    points: np.ndarray,
    normals: np.ndarray,
    tolerance: float,
    first: int,
    last: int,
    colour: np.ndarray,
    seen: np.ndarray,
    past: np.ndarray,
) -> None:
    """Fill rows first..last: colour (n, 3) float32 in the mean of the views that see a point, by how they face it.

    seen (n,) float32: the weight of these; past (n,): that of the views that see something beyond the point. A point
    is seen at its depth up to `tolerance`.
    """
    for q in range(first, last):
        colour[q], seen[q], past[q] = 0, 0, 0
        x, y, z = points[q]
        n0, n1, n2 = normals[q]
        for v in range(views.depth.shape[0]):
            turn, shift = views.turn[v], views.shift[v]
            p2 = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z + shift[2]
            if p2 <= NEAREST:
                continue
            p0 = turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z + shift[0]
            p1 = turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z + shift[1]
            s, t = p0 / p2, p1 / p2
            column, row = views.lens[v, 0] * s + views.lens[v, 2], views.lens[v, 1] * t + views.lens[v, 3]
            width, height = views.size[v]
            if not in_image(column, row, width, height):
                continue
            depth, least = depth_at(views.depth[v], column, row, width, height, tolerance)
            if depth <= 0:
                continue
            m0 = turn[0, 0] * n0 + turn[0, 1] * n1 + turn[0, 2] * n2
            m1 = turn[1, 0] * n0 + turn[1, 1] * n1 + turn[1, 2] * n2
            m2 = turn[2, 0] * n0 + turn[2, 1] * n1 + turn[2, 2] * n2
            cosine = -(m0 * s + m1 * t + m2) / np.float32(math.sqrt(ONE + s * s + t * t))
            if min(depth, least) > p2 + tolerance:
                past[q] += np.float32(1) / (p2 * p2)
            elif abs(depth - p2) <= tolerance and cosine > 0:
                w = cosine * cosine / (p2 * p2)
                r0, c0 = int(row + HALF), int(column + HALF)
                for channel in range(3):
                    colour[q, channel] += w * np.float32(views.rgb[v, r0, c0, channel])
                seen[q] += w
        if seen[q] > 0:
            for channel in range(3):
                colour[q, channel] /= seen[q]
