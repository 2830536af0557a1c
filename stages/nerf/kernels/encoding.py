"""Multiresolution hash encoding (Müller et al., "Instant Neural Graphics Primitives", 2022): forward and backward.

A plan (table rows and weights of the corners) is made for a block of samples at once, in loops over samples that the
compiler turns into vector instructions; then the features of each sample are gathered, four in one register. Table rows
are unsigned: numba then drops its test for negative indices from the innermost loops.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from fieldpose.stages.fastmath import FASTMATH
from fieldpose.stages.nerf.kernels.types import Net, Samples
from fieldpose.stages.nerf.kernels.vectors import BLOCK, WIDTH, blend4, dot4, spread4

PRIME_Y = np.uint32(2654435761)
PRIME_Z = np.uint32(805459861)
U = np.uint64
U32 = np.uint32
LANES = 16


@njit(inline="always")
def cell(u: float, resolution: float) -> tuple[int, float]:
    """Cell index along an axis and the position in it."""
    scaled = u * resolution
    index = np.int32(min(max(scaled, np.float32(0)), resolution - np.float32(1)))
    return index, scaled - np.float32(index)


@njit(nogil=True, fastmath=FASTMATH)
def plan_weights(
    u: np.ndarray, v: np.ndarray, w: np.ndarray, first: int, count: int, resolution: float, out: np.ndarray
) -> None:
    """Trilinear weights of the corners (x fastest) of samples first..first+count: out[corner * BLOCK + sample]."""
    one = np.float32(1)
    for s in range(count):
        k, q = U(s), U(first + s)
        _, fx = cell(u[q], resolution)
        _, fy = cell(v[q], resolution)
        _, fz = cell(w[q], resolution)
        gx, gy, gz = one - fx, one - fy, one - fz
        a, b, c, d = gy * gz, fy * gz, gy * fz, fy * fz
        out[k], out[k + U(BLOCK)] = gx * a, fx * a
        out[k + U(2 * BLOCK)], out[k + U(3 * BLOCK)] = gx * b, fx * b
        out[k + U(4 * BLOCK)], out[k + U(5 * BLOCK)] = gx * c, fx * c
        out[k + U(6 * BLOCK)], out[k + U(7 * BLOCK)] = gx * d, fx * d


@njit(nogil=True, fastmath=FASTMATH)
def plan_hashed(
    u: np.ndarray, v: np.ndarray, w: np.ndarray, first: int, count: int,
    resolution: float, mask: int, offset: int, out: np.ndarray,
) -> None:  # fmt: skip
    """Table rows of the corners in a hashed level; as plan_weights."""
    for s in range(count):
        k, q = U(s), U(first + s)
        ix, _ = cell(u[q], resolution)
        iy, _ = cell(v[q], resolution)
        iz, _ = cell(w[q], resolution)
        x0, y0, z0 = U32(ix), U32(U32(iy) * PRIME_Y), U32(U32(iz) * PRIME_Z)
        x1, y1, z1 = U32(x0 + U32(1)), U32(y0 + PRIME_Y), U32(z0 + PRIME_Z)
        a, b, c, d = U32(y0 ^ z0), U32(y1 ^ z0), U32(y0 ^ z1), U32(y1 ^ z1)
        out[k], out[k + U(BLOCK)] = U32(offset + ((x0 ^ a) & mask)), U32(offset + ((x1 ^ a) & mask))
        out[k + U(2 * BLOCK)], out[k + U(3 * BLOCK)] = U32(offset + ((x0 ^ b) & mask)), U32(offset + ((x1 ^ b) & mask))
        out[k + U(4 * BLOCK)], out[k + U(5 * BLOCK)] = U32(offset + ((x0 ^ c) & mask)), U32(offset + ((x1 ^ c) & mask))
        out[k + U(6 * BLOCK)], out[k + U(7 * BLOCK)] = U32(offset + ((x0 ^ d) & mask)), U32(offset + ((x1 ^ d) & mask))


@njit(nogil=True, fastmath=FASTMATH)
def plan_dense(
    u: np.ndarray, v: np.ndarray, w: np.ndarray, first: int, count: int,
    resolution: float, side: int, offset: int, out: np.ndarray,
) -> None:  # fmt: skip
    """Table rows of the corners in a dense level with `side` entries along an axis; as plan_weights."""
    plane, one = U32(side * side), U32(1)
    for s in range(count):
        k, q = U(s), U(first + s)
        ix, _ = cell(u[q], resolution)
        iy, _ = cell(v[q], resolution)
        iz, _ = cell(w[q], resolution)
        row = U32(offset + U32(U32(ix) + U32(side * U32(U32(iy) + U32(side * U32(iz))))))
        out[k], out[k + U(BLOCK)] = row, U32(row + one)
        out[k + U(2 * BLOCK)], out[k + U(3 * BLOCK)] = U32(row + side), U32(row + side + one)
        out[k + U(4 * BLOCK)], out[k + U(5 * BLOCK)] = U32(row + plane), U32(row + plane + one)
        out[k + U(6 * BLOCK)], out[k + U(7 * BLOCK)] = U32(row + plane + side), U32(row + plane + side + one)


@njit(nogil=True, fastmath=FASTMATH)
def plan(net: Net, samples: Samples, level: int, first: int, count: int) -> None:
    """Fill samples.corner_rows and corner_weights for rows first..first+count (at most BLOCK) in a level.

    Whole vectors are filled; beyond the count is whatever was in the rows.
    """
    resolution = np.float32(net.resolutions[level])
    u, v, w = samples.u[0], samples.u[1], samples.u[2]
    whole = (count + LANES - 1) // LANES * LANES
    plan_weights(u, v, w, first, whole, resolution, samples.corner_weights)
    mask, offset = net.masks[level], U32(net.offsets[level])
    if mask < 0:
        side = U32(net.resolutions[level] + 1)
        plan_dense(u, v, w, first, whole, resolution, side, offset, samples.corner_rows)
    else:
        plan_hashed(u, v, w, first, whole, resolution, U32(mask), offset, samples.corner_rows)


@njit(nogil=True, fastmath=FASTMATH)
def encode(net: Net, samples: Samples, first: int, last: int) -> None:
    """Write the encoding of rows first..last of samples.u into samples.x."""
    table, x = net.table, samples.x.reshape(-1)
    width, inputs = table.shape[1], samples.x.shape[1]
    rows, weights = samples.corner_rows, samples.corner_weights
    for start in range(first, last, BLOCK):
        count = min(BLOCK, last - start)
        for level in range(net.offsets.shape[0]):
            plan(net, samples, level, start, count)
            at = start * inputs + level * width
            if width == WIDTH:
                for s in range(count):
                    blend4(table, rows, weights, s, x, at + s * inputs)
            else:
                for s in range(count):
                    for f in range(width):
                        total = np.float32(0)
                        for corner in range(8):
                            k = U(corner * BLOCK + s)
                            total += weights[k] * table[rows[k], U(f)]
                        x[U(at + s * inputs + f)] = total


@njit(nogil=True, fastmath=FASTMATH)
def scatter(net: Net, samples: Samples, first: int, last: int, dtable: np.ndarray) -> None:
    """Add the gradient of the encoding, samples.dx[first:last], to the table's gradient."""
    dx = samples.dx.reshape(-1)
    width, inputs = dtable.shape[1], samples.dx.shape[1]
    rows, weights = samples.corner_rows, samples.corner_weights
    for start in range(first, last, BLOCK):
        count = min(BLOCK, last - start)
        for level in range(net.offsets.shape[0]):
            plan(net, samples, level, start, count)
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


@njit(nogil=True, fastmath=FASTMATH)
def position_gradients(net: Net, samples: Samples, first: int, last: int, du: np.ndarray) -> None:
    """Write into du (3, n) the gradients with respect to samples.u of the encoding whose gradient is samples.dx."""
    one = np.float32(1)
    dx = samples.dx.reshape(-1)
    width, inputs = net.table.shape[1], samples.dx.shape[1]
    rows = samples.corner_rows
    du[:, first:last] = 0
    for start in range(first, last, BLOCK):
        count = min(BLOCK, last - start)
        for level in range(net.offsets.shape[0]):
            plan(net, samples, level, start, count)
            resolution = np.float32(net.resolutions[level])
            for s in range(count):
                q = U(start + s)
                _, fx = cell(samples.u[0, q], resolution)
                _, fy = cell(samples.u[1, q], resolution)
                _, fz = cell(samples.u[2, q], resolution)
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
