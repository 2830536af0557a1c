"""Multiresolution hash encoding (Müller et al., "Instant Neural Graphics Primitives", 2022): forward and backward.

Table rows are unsigned: numba then drops its test for negative indices from the innermost loops.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from stages.nerf.kernels.types import FASTMATH, Net

PRIME_Y = 2654435761
PRIME_Z = 805459861
U = np.uint64


@njit(inline="always")
def cell(u: float, resolution: int) -> tuple[int, float]:
    """Cell index along an axis and the position in it."""
    scaled = u * np.float32(resolution)
    index = min(max(int(scaled), 0), resolution - 1)
    return index, scaled - np.float32(index)


@njit(inline="always")
def corner_rows(ix: int, iy: int, iz: int, resolution: int, mask: int, offset: int) -> tuple[int, ...]:
    """Table rows of a cell's eight corners, x fastest; mask < 0 says that the level is dense."""
    if mask < 0:
        side = resolution + 1
        x, y, z = offset + ix, iy * side, iz * side * side
        a, b, c, d = x + y + z, x + y + side + z, x + y + z + side * side, x + y + side + z + side * side
        return U(a), U(a + 1), U(b), U(b + 1), U(c), U(c + 1), U(d), U(d + 1)
    x1, y0, z0 = ix + 1, iy * PRIME_Y, iz * PRIME_Z
    y1, z1 = y0 + PRIME_Y, z0 + PRIME_Z
    a, b, c, d = y0 ^ z0, y1 ^ z0, y0 ^ z1, y1 ^ z1
    return (
        U(offset + ((ix ^ a) & mask)), U(offset + ((x1 ^ a) & mask)),
        U(offset + ((ix ^ b) & mask)), U(offset + ((x1 ^ b) & mask)),
        U(offset + ((ix ^ c) & mask)), U(offset + ((x1 ^ c) & mask)),
        U(offset + ((ix ^ d) & mask)), U(offset + ((x1 ^ d) & mask)),
    )  # fmt: skip


@njit(inline="always")
def corner_weights(fx: float, fy: float, fz: float) -> tuple[float, ...]:
    """Trilinear weights of the corners in the order of corner_rows."""
    one = np.float32(1)
    gx, gy, gz = one - fx, one - fy, one - fz
    a, b, c, d = gy * gz, fy * gz, gy * fz, fy * fz
    return gx * a, fx * a, gx * b, fx * b, gx * c, fx * c, gx * d, fx * d


@njit(inline="always")
def blend(table: np.ndarray, rows: tuple[int, ...], weights: tuple[float, ...], f: int) -> float:
    """Feature f interpolated between the corners."""
    total = weights[0] * table[rows[0], f]
    for k in range(1, 8):
        total += weights[k] * table[rows[k], f]
    return total


@njit(nogil=True, fastmath=FASTMATH)
def encode(net: Net, u: np.ndarray, first: int, last: int, x: np.ndarray) -> None:
    """Write the encoding of u[first:last] into x[first:last]."""
    table = net.table
    width = table.shape[1]
    for level in range(net.offsets.shape[0]):
        resolution, mask, offset = net.resolutions[level], net.masks[level], net.offsets[level]
        column = level * width
        for s in range(first, last):
            ix, fx = cell(u[U(s), 0], resolution)
            iy, fy = cell(u[U(s), 1], resolution)
            iz, fz = cell(u[U(s), 2], resolution)
            r = corner_rows(ix, iy, iz, resolution, mask, offset)
            w = corner_weights(fx, fy, fz)
            if width == 4:  # a constant length lets the compiler keep the four in one register
                for f in range(4):
                    x[U(s), U(column + f)] = blend(table, r, w, U(f))
            else:
                for f in range(width):
                    x[U(s), U(column + f)] = blend(table, r, w, U(f))


@njit(nogil=True, fastmath=FASTMATH)
def scatter(net: Net, u: np.ndarray, dx: np.ndarray, first: int, last: int, dtable: np.ndarray) -> None:
    """Add the gradient of the encoding, dx[first:last], to the table's gradient."""
    width = net.table.shape[1]
    for level in range(net.offsets.shape[0]):
        resolution, mask, offset = net.resolutions[level], net.masks[level], net.offsets[level]
        column = level * width
        for s in range(first, last):
            ix, fx = cell(u[U(s), 0], resolution)
            iy, fy = cell(u[U(s), 1], resolution)
            iz, fz = cell(u[U(s), 2], resolution)
            r = corner_rows(ix, iy, iz, resolution, mask, offset)
            w = corner_weights(fx, fy, fz)
            if width == 4:
                g0, g1 = dx[U(s), U(column)], dx[U(s), U(column + 1)]
                g2, g3 = dx[U(s), U(column + 2)], dx[U(s), U(column + 3)]
                for k in range(8):
                    dtable[r[k], 0] += w[k] * g0
                    dtable[r[k], 1] += w[k] * g1
                    dtable[r[k], 2] += w[k] * g2
                    dtable[r[k], 3] += w[k] * g3
            else:
                for k in range(8):
                    for f in range(width):
                        dtable[r[k], U(f)] += w[k] * dx[U(s), U(column + f)]


@njit(inline="always")
def pull(table: np.ndarray, row: int, dx: np.ndarray, s: int, column: int, width: int) -> float:
    """How the loss changes with the weight of a table row."""
    total = np.float32(0)
    for f in range(width):
        total += table[row, U(f)] * dx[s, column + f]
    return total


@njit(nogil=True, fastmath=FASTMATH)
def position_gradient(net: Net, u: np.ndarray, dx: np.ndarray, s: int, du: np.ndarray) -> None:
    """Write into du (3,) the gradient with respect to u[s] of the encoding whose gradient is dx[s]."""
    width = net.table.shape[1]
    one = np.float32(1)
    total_x = total_y = total_z = np.float32(0)
    for level in range(net.offsets.shape[0]):
        resolution, column = net.resolutions[level], level * width
        ix, fx = cell(u[s, 0], resolution)
        iy, fy = cell(u[s, 1], resolution)
        iz, fz = cell(u[s, 2], resolution)
        r = corner_rows(ix, iy, iz, resolution, net.masks[level], net.offsets[level])
        gx, gy, gz = one - fx, one - fy, one - fz
        for k in range(0, 8, 2):
            low = pull(net.table, r[k], dx, s, column, width)
            high = pull(net.table, r[k + 1], dx, s, column, width)
            by, bz = (k >> 1) & 1, k >> 2
            wy, wz = fy if by else gy, fz if bz else gz
            mean = gx * low + fx * high
            total_x += resolution * (high - low) * wy * wz
            total_y += resolution * (mean if by else -mean) * wz
            total_z += resolution * (mean if bz else -mean) * wy
    du[0], du[1], du[2] = total_x, total_y, total_z
