"""Finding small patches of one image in another, where it is known how they are warped and nearly where they are.

Source: Baker and Matthews, Lucas-Kanade 20 years on (2004): the inverse compositional algorithm, for shifts, on patches
freed of brightness and contrast.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from fieldpose.stages.fastmath import FASTMATH
from fieldpose.stages.kernel_cache import cached_njit

_LEAST_CONTRAST = np.float32(1e-3)
_LEAST_TEXTURE = 1e-5
_CONVERGED = np.float32(0.01)
_LONGEST_STEP = np.float32(1)
_FARTHEST = np.float32(3)


@njit(inline="always")
def _inside(x: float, end: float) -> float:
    return min(max(x, np.float32(0)), end)


@njit(nogil=True, fastmath=FASTMATH)
def _sample(
    image: np.ndarray, width: int, height: int, x: float, y: float, across: np.ndarray, down: np.ndarray,
    out: np.ndarray,
) -> None:  # fmt: skip
    """Bilinear values out (k,) of a flat image at offsets (k,) from (x, y); beyond the border is its own value."""
    right, bottom = np.float32(width - 1), np.float32(height - 1)
    last_column, last_row = np.int32(width - 2), np.int32(height - 2)
    row_length = np.int32(width)
    for k in range(out.shape[0]):
        px, py = _inside(x + across[k], right), _inside(y + down[k], bottom)
        column, row = min(np.int32(px), last_column), min(np.int32(py), last_row)
        u, v = px - np.float32(column), py - np.float32(row)
        at = np.uint32(row * row_length + column)
        below = np.uint32(at + np.uint32(row_length))
        above_value = image[at] + u * (image[at + np.uint32(1)] - image[at])
        below_value = image[below] + u * (image[below + np.uint32(1)] - image[below])
        out[k] = above_value + v * (below_value - above_value)


@njit(nogil=True, fastmath=FASTMATH)
def _centred(values: np.ndarray, weight: np.ndarray) -> float:
    """Take the weighted mean from values (k,), and return their weighted power."""
    mean, power = np.float32(0), np.float32(0)
    for k in range(values.shape[0]):
        mean += weight[k] * values[k]
    for k in range(values.shape[0]):
        values[k] -= mean
        power += weight[k] * values[k] * values[k]
    return power


@njit(nogil=True, fastmath=FASTMATH)
def _product(first: np.ndarray, second: np.ndarray, weight: np.ndarray) -> float:
    total = np.float32(0)
    for k in range(first.shape[0]):
        total += weight[k] * first[k] * second[k]
    return total


@njit(nogil=True, fastmath=FASTMATH)
def _slopes(patch: np.ndarray, side: int, across: np.ndarray, down: np.ndarray) -> None:
    """Derivatives of a flat patch along its rows and columns, one-sided at its ends."""
    for j in range(side):
        above, under = max(j - 1, 0), min(j + 1, side - 1)
        for i in range(side):
            left, right = max(i - 1, 0), min(i + 1, side - 1)
            across[j * side + i] = (patch[j * side + right] - patch[j * side + left]) / np.float32(right - left)
            down[j * side + i] = (patch[under * side + i] - patch[above * side + i]) / np.float32(under - above)


@njit(nogil=True)
def _window(half: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Offsets across and down of a patch's samples, row by row, and their weights, which add up to 1."""
    side = 2 * half + 1
    count = side * side
    x_offset, y_offset = np.empty(count, np.float32), np.empty(count, np.float32)
    weight, total = np.empty(count, np.float32), np.float32(0)
    for k in range(count):
        dx, dy = k % side - half, k // side - half
        x_offset[k], y_offset[k] = dx, dy
        weight[k] = math.exp(-(dx * dx + dy * dy) / (2 * (0.6 * half) ** 2))
        total += weight[k]
    for k in range(count):
        weight[k] /= total
    return x_offset, y_offset, weight


@cached_njit(nogil=True)
def find_patches(
    first: np.ndarray,
    second: np.ndarray,
    centres: np.ndarray,
    first_from_second: np.ndarray,
    starts: np.ndarray,
    half: int,
    steps: int,
    places: np.ndarray,
    similarity: np.ndarray,
    covariance: np.ndarray,
) -> None:
    """Fill places (n, 2), where patches of the first image are in the second, their similarity (n,) and covariance.

    first, second: (h, w) float32.  centres (n, 2): pixels of the first, starts (n, 2): about where they are in the
    second.  first_from_second (n, 2, 2): how offsets from the one become offsets from the other.  A patch has
    2 half + 1 samples a side, a pixel of the second apart.  similarity: normalised correlation, weighted towards the
    middle, -1 to 1; -1 where the patch is too plain to be placed or the search leads away by three pixels or more
    (the place is then the start). covariance (n, 2, 2): of the place, by what is left of the patch's grey values, taken
    to be noise: along an edge it is large. All float32.
    """
    if min(first.shape[0], first.shape[1], second.shape[0], second.shape[1]) < 2:
        places[:], similarity[:], covariance[:] = starts, -1, 0
        return
    side = 2 * half + 1
    count = side * side
    x_offset, y_offset, weight = _window(half)
    independent = np.float32(1) / _product(weight, weight, np.ones_like(weight))
    patch, other = np.empty(count, np.float32), np.empty(count, np.float32)
    warped_x, warped_y = np.empty(count, np.float32), np.empty(count, np.float32)
    across, down = np.empty(count, np.float32), np.empty(count, np.float32)
    flat, flat_there = first.reshape(-1), second.reshape(-1)
    for i in range(centres.shape[0]):
        places[i] = starts[i]
        similarity[i] = -1
        covariance[i] = 0
        a, b, c, d = first_from_second[i].flat
        for k in range(count):
            warped_x[k] = a * x_offset[k] + b * y_offset[k]
            warped_y[k] = c * x_offset[k] + d * y_offset[k]
        _sample(flat, first.shape[1], first.shape[0], centres[i, 0], centres[i, 1], warped_x, warped_y, patch)
        contrast = math.sqrt(_centred(patch, weight))
        _slopes(patch, side, across, down)
        xx, yy = _centred(across, weight), _centred(down, weight)
        xy = _product(across, down, weight)
        weakest = (xx + yy) / 2 - math.sqrt((xx - yy) * (xx - yy) / 4 + xy * xy)
        if not weakest > _LEAST_TEXTURE:
            continue
        determinant = xx * yy - xy * xy
        x, y = starts[i]
        correlation = np.float32(-1)
        for _ in range(steps):
            _sample(flat_there, second.shape[1], second.shape[0], x, y, x_offset, y_offset, other)
            contrast_there = max(math.sqrt(_centred(other, weight)), _LEAST_CONTRAST)
            correlation = _product(patch, other, weight) / (contrast * contrast_there)
            for k in range(count):
                other[k] = other[k] * (contrast / contrast_there) - patch[k]
            pull_x, pull_y = _product(across, other, weight), _product(down, other, weight)
            shift_x = (yy * pull_x - xy * pull_y) / determinant
            shift_y = (xx * pull_y - xy * pull_x) / determinant
            x -= min(max(shift_x, -_LONGEST_STEP), _LONGEST_STEP)
            y -= min(max(shift_y, -_LONGEST_STEP), _LONGEST_STEP)
            if shift_x * shift_x + shift_y * shift_y < _CONVERGED**2:
                break
        if (x - starts[i, 0]) ** 2 + (y - starts[i, 1]) ** 2 < _FARTHEST**2:
            places[i, 0], places[i, 1] = x, y
            similarity[i] = correlation
            # What is left of a patch has 2 (1 - correlation) of its power, both being scaled to the same.
            noise = 2 * max(1 - correlation, np.float32(0)) * contrast * contrast / (independent * determinant)
            covariance[i, 0, 0], covariance[i, 1, 1] = noise * yy, noise * xx
            covariance[i, 0, 1] = covariance[i, 1, 0] = -noise * xy
