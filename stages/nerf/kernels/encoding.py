"""Multiresolution hash encoding (Müller et al., "Instant Neural Graphics Primitives", 2022): forward and backward."""

from __future__ import annotations

import numpy as np
from numba import njit

from stages.nerf.kernels.types import FASTMATH, Net

PRIME_Y = 2654435761
PRIME_Z = 805459861


@njit(inline="always")
def corner(ix: int, iy: int, iz: int, resolution: int, mask: int) -> int:
    """Row of a grid vertex within its level."""
    if mask < 0:
        side = resolution + 1
        return ix + side * (iy + side * iz)
    return (ix ^ (iy * PRIME_Y) ^ (iz * PRIME_Z)) & mask


@njit(inline="always")
def cell(u: float, resolution: int) -> tuple[int, float]:
    """Cell index along an axis and the position in it."""
    scaled = u * np.float32(resolution)
    index = min(max(int(scaled), 0), resolution - 1)
    return index, scaled - np.float32(index)


@njit(nogil=True, fastmath=FASTMATH)
def encode(net: Net, u: np.ndarray, first: int, last: int, x: np.ndarray) -> None:
    """Write the encoding of u[first:last] into x[first:last]."""
    table = net.table
    width = table.shape[1]
    one = np.float32(1)
    for level in range(net.offsets.shape[0]):
        resolution, mask, offset = net.resolutions[level], net.masks[level], net.offsets[level]
        column = level * width
        for s in range(first, last):
            ix, fx = cell(u[s, 0], resolution)
            iy, fy = cell(u[s, 1], resolution)
            iz, fz = cell(u[s, 2], resolution)
            if width == 4:
                a0 = a1 = a2 = a3 = np.float32(0)
                for c in range(8):
                    bx, by, bz = c & 1, (c >> 1) & 1, c >> 2
                    wx = fx if bx else one - fx
                    wy = fy if by else one - fy
                    wz = fz if bz else one - fz
                    w = wx * wy * wz
                    row = offset + corner(ix + bx, iy + by, iz + bz, resolution, mask)
                    a0 += w * table[row, 0]
                    a1 += w * table[row, 1]
                    a2 += w * table[row, 2]
                    a3 += w * table[row, 3]
                x[s, column], x[s, column + 1], x[s, column + 2], x[s, column + 3] = a0, a1, a2, a3
            else:
                for f in range(width):
                    x[s, column + f] = 0
                for c in range(8):
                    bx, by, bz = c & 1, (c >> 1) & 1, c >> 2
                    w = (fx if bx else one - fx) * (fy if by else one - fy) * (fz if bz else one - fz)
                    row = offset + corner(ix + bx, iy + by, iz + bz, resolution, mask)
                    for f in range(width):
                        x[s, column + f] += w * table[row, f]


@njit(nogil=True, fastmath=FASTMATH)
def scatter(net: Net, u: np.ndarray, dx: np.ndarray, first: int, last: int, dtable: np.ndarray) -> None:
    """Add the gradient of the encoding, dx[first:last], to the table's gradient."""
    width = net.table.shape[1]
    one = np.float32(1)
    for level in range(net.offsets.shape[0]):
        resolution, mask, offset = net.resolutions[level], net.masks[level], net.offsets[level]
        column = level * width
        for s in range(first, last):
            ix, fx = cell(u[s, 0], resolution)
            iy, fy = cell(u[s, 1], resolution)
            iz, fz = cell(u[s, 2], resolution)
            if width == 4:
                g0, g1, g2, g3 = dx[s, column], dx[s, column + 1], dx[s, column + 2], dx[s, column + 3]
                for c in range(8):
                    bx, by, bz = c & 1, (c >> 1) & 1, c >> 2
                    w = (fx if bx else one - fx) * (fy if by else one - fy) * (fz if bz else one - fz)
                    row = offset + corner(ix + bx, iy + by, iz + bz, resolution, mask)
                    dtable[row, 0] += w * g0
                    dtable[row, 1] += w * g1
                    dtable[row, 2] += w * g2
                    dtable[row, 3] += w * g3
            else:
                for c in range(8):
                    bx, by, bz = c & 1, (c >> 1) & 1, c >> 2
                    w = (fx if bx else one - fx) * (fy if by else one - fy) * (fz if bz else one - fz)
                    row = offset + corner(ix + bx, iy + by, iz + bz, resolution, mask)
                    for f in range(width):
                        dtable[row, f] += w * dx[s, column + f]


@njit(nogil=True, fastmath=FASTMATH)
def position_gradient(net: Net, u: np.ndarray, dx: np.ndarray, s: int, du: np.ndarray) -> None:
    """Write into du (3,) the gradient with respect to u[s] of the encoding whose gradient is dx[s]."""
    table = net.table
    width = table.shape[1]
    one = np.float32(1)
    gx = gy = gz = np.float32(0)
    for level in range(net.offsets.shape[0]):
        resolution, mask, offset = net.resolutions[level], net.masks[level], net.offsets[level]
        column = level * width
        ix, fx = cell(u[s, 0], resolution)
        iy, fy = cell(u[s, 1], resolution)
        iz, fz = cell(u[s, 2], resolution)
        scale = np.float32(resolution)
        for c in range(8):
            bx, by, bz = c & 1, (c >> 1) & 1, c >> 2
            row = offset + corner(ix + bx, iy + by, iz + bz, resolution, mask)
            dot = np.float32(0)
            for f in range(width):
                dot += table[row, f] * dx[s, column + f]
            dot *= scale
            wx = fx if bx else one - fx
            wy = fy if by else one - fy
            wz = fz if bz else one - fz
            gx += (dot if bx else -dot) * wy * wz
            gy += (dot if by else -dot) * wx * wz
            gz += (dot if bz else -dot) * wx * wy
    du[0], du[1], du[2] = gx, gy, gz
