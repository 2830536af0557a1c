"""Multiresolution hash encoding (Müller et al., "Instant Neural Graphics Primitives", 2022): forward and backward.

A plan (table rows and weights of the corners) is made for a block of samples at once; then their features are gathered,
those of several samples in one register. Table rows are unsigned: numba then drops its test for negative indices from
the innermost loops.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from fieldpose.stages.nerf.kernels.inner import inner
from fieldpose.stages.nerf.kernels.plan import LANES, plan_dense, plan_hashed
from fieldpose.stages.nerf.kernels.types import Net, Samples
from fieldpose.stages.nerf.kernels.vectors import BLOCK, TOGETHER, WIDTH, blend_one, blend_several, dot4, spread4

U = np.uint64
U32 = np.uint32


@njit(inline="always")
def cell(u: float, resolution: float) -> tuple[int, float]:
    """Cell index along an axis and the position in it."""
    scaled = u * resolution
    index = np.int32(min(max(scaled, np.float32(0)), resolution - np.float32(1)))
    return index, scaled - np.float32(index)


@njit(inline="always")
def plan(
    u: np.ndarray, first: int, count: int, resolution: float, mask: int, offset: int,
    rows: np.ndarray, weights: np.ndarray,
) -> None:  # fmt: skip
    """Fill table rows and weights of the corners around u[:, first:first + count] (at most BLOCK) in a level.

    Whole vectors are filled; beyond the count is whatever was in u.
    """
    for s in range(0, count, LANES):
        if mask < 0:
            plan_dense(u, first + s, resolution, U32(resolution) + U32(1), U32(offset), rows, weights, s)
        else:
            plan_hashed(u, first + s, resolution, U32(mask), U32(offset), rows, weights, s)


@inner
def encode(net: Net, samples: Samples, first: int, last: int) -> None:
    """Write the encoding of rows first..last of samples.u into samples.x."""
    table, x = net.table, samples.x.reshape(-1)
    width, inputs = table.shape[1], samples.x.shape[1]
    u, rows, weights = samples.u, samples.corner_rows, samples.corner_weights
    offsets, resolutions, masks = net.offsets, net.resolutions, net.masks
    for start in range(first, last, BLOCK):
        count = min(BLOCK, last - start)
        for level in range(offsets.shape[0]):
            plan(u, start, count, np.float32(resolutions[level]), masks[level], offsets[level], rows, weights)
            at = start * inputs + level * width
            if width == WIDTH:
                several = count // TOGETHER * TOGETHER
                for s in range(0, several, TOGETHER):
                    blend_several(table, rows, weights, s, x, at + s * inputs, inputs)
                for s in range(several, count):
                    blend_one(table, rows, weights, s, x, at + s * inputs, inputs)
            else:
                for s in range(count):
                    for f in range(width):
                        total = np.float32(0)
                        for corner in range(8):
                            k = U(corner * BLOCK + s)
                            total += weights[k] * table[rows[k], U(f)]
                        x[U(at + s * inputs + f)] = total


@inner
def scatter(net: Net, samples: Samples, first: int, last: int, dtable: np.ndarray) -> None:
    """Add the gradient of the encoding, samples.dx[first:last], to the table's gradient."""
    dx = samples.dx.reshape(-1)
    width, inputs = dtable.shape[1], samples.dx.shape[1]
    u, rows, weights = samples.u, samples.corner_rows, samples.corner_weights
    offsets, resolutions, masks = net.offsets, net.resolutions, net.masks
    for start in range(first, last, BLOCK):
        count = min(BLOCK, last - start)
        for level in range(offsets.shape[0]):
            plan(u, start, count, np.float32(resolutions[level]), masks[level], offsets[level], rows, weights)
            at = start * inputs + level * width
            if width == WIDTH:
                for s in range(count):
                    spread4(dtable, rows, weights, s, dx, at + s * inputs)
            else:
                for s in range(count):
                    for corner in range(8):
                        k = U(corner * BLOCK + s)
                        for f in range(width):
                            dtable[rows[k], U(f)] += weights[k] * dx[U(at + s * inputs + f)]


@njit(inline="always")
def pull(table: np.ndarray, row: int, dx: np.ndarray, at: int) -> float:
    """How the loss changes with the weight of a table row; dx flat."""
    width = table.shape[1]
    if width == WIDTH:
        return dot4(table, row, dx, at)
    total = np.float32(0)
    for f in range(width):
        total += table[row, U(f)] * dx[U(at + f)]
    return total


@inner
def position_gradients(net: Net, samples: Samples, first: int, last: int, du: np.ndarray) -> None:
    """Write into du (3, n) the gradients with respect to samples.u of the encoding whose gradient is samples.dx."""
    one = np.float32(1)
    dx = samples.dx.reshape(-1)
    width, inputs = net.table.shape[1], samples.dx.shape[1]
    u, rows, weights = samples.u, samples.corner_rows, samples.corner_weights
    offsets, resolutions, masks = net.offsets, net.resolutions, net.masks
    du[:, first:last] = 0
    for start in range(first, last, BLOCK):
        count = min(BLOCK, last - start)
        for level in range(offsets.shape[0]):
            resolution = np.float32(resolutions[level])
            plan(u, start, count, resolution, masks[level], offsets[level], rows, weights)
            for s in range(count):
                q = U(start + s)
                _, fx = cell(u[0, q], resolution)
                _, fy = cell(u[1, q], resolution)
                _, fz = cell(u[2, q], resolution)
                gx, gy, gz = one - fx, one - fy, one - fz
                at = (start + s) * inputs + level * width
                for k in range(0, 8, 2):
                    low = pull(net.table, np.int64(rows[U(k * BLOCK + s)]), dx, at)
                    high = pull(net.table, np.int64(rows[U((k + 1) * BLOCK + s)]), dx, at)
                    by, bz = (k >> 1) & 1, k >> 2
                    wy, wz = fy if by else gy, fz if bz else gz
                    mean = gx * low + fx * high
                    du[0, q] += resolution * (high - low) * wy * wz
                    du[1, q] += resolution * (mean if by else -mean) * wz
                    du[2, q] += resolution * (mean if bz else -mean) * wy
