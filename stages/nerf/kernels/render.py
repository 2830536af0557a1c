"""Render rays, or the tiles of a view: colour, depth and opacity."""

from __future__ import annotations

import numpy as np
from numba import njit

from fieldpose.stages.fastmath import FASTMATH
from fieldpose.stages.kernel_cache import cached_njit
from fieldpose.stages.nerf.kernels.march import begin
from fieldpose.stages.nerf.kernels.packet import forward, shade, surface, trace
from fieldpose.stages.nerf.kernels.sight import narrow
from fieldpose.stages.nerf.kernels.types import Domain, Net, Rays, Samples, Tiles


@cached_njit(nogil=True, fastmath=FASTMATH)
def render(
    net: Net,
    dom: Domain,
    origins: np.ndarray,
    directions: np.ndarray,
    jitter: np.ndarray,
    background: np.ndarray,
    first: int,
    last: int,
    per_ray: int,
    stop_below: float,
    samples: Samples,
    rays: Rays,
    rgb: np.ndarray,
    depth: np.ndarray,
    opacity: np.ndarray,
) -> int:
    """Fill rgb, depth (distance along the unit direction, 0 where nothing) and opacity; return the samples used."""
    size = rays.opacity.shape[0]
    total = 0
    for start in range(first, last, size):
        count = min(size, last - start)
        _, evaluated = forward(
            net, dom, origins, directions, jitter, start, count, per_ray, stop_below, np.bool_(False), samples, rays
        )
        total += evaluated
        for r in range(count):
            for c in range(3):
                rgb[start + r, c] = shade(rays, r, c, background[c])
            opacity[start + r] = rays.opacity[r]
            depth[start + r] = surface(rays, r)
    return total


@njit(inline="always")
def level_of(colour: float) -> int:
    """A colour channel in 0..1 as 0..255."""
    return np.uint8(min(max(colour, np.float32(0)), np.float32(1)) * np.float32(255) + np.float32(0.5))


@cached_njit(nogil=True, fastmath=FASTMATH)
def render_tiles(
    net: Net,
    dom: Domain,
    tiles: Tiles,
    limits: np.ndarray,
    turn: np.ndarray,
    origin: np.ndarray,
    scale: float,
    background: np.ndarray,
    first: int,
    last: int,
    per_ray: int,
    stop_below: float,
    samples: Samples,
    rays: Rays,
    rgb: np.ndarray,
    depth: np.ndarray,
    opacity: np.ndarray,
) -> int:
    """Fill what tiles first..last show of rgb (pixels, 3) uint8, depth and opacity (pixels,); return the samples used.

    limits (tiles, 2): between which distances a tile's rays are traced, where far <= near not at all.  turn (3, 3)
    into the camera's axes and origin (3,) of the field's coordinates, whose unit is `scale` of the caller's.  depth is
    along the optical axis.
    """
    size, total, zero = rays.opacity.shape[0], 0, np.int64(0)
    origins, directions = np.empty((size, 3), np.float32), np.empty((size, 3), np.float32)
    middle = np.full(size, np.float32(0.5))
    origins[:] = origin
    for tile in range(first, last):
        start, count = tiles.first[tile], tiles.first[tile + 1] - tiles.first[tile]
        if limits[tile, 1] <= limits[tile, 0]:
            for r in range(count):
                pixel = tiles.pixel[start + r]
                for c in range(3):
                    rgb[pixel, c] = level_of(background[c])
                depth[pixel], opacity[pixel] = 0, 0
            continue
        for r in range(count):
            x, y, z = tiles.unit[start + r]
            for c in range(3):
                directions[r, c] = x * turn[0, c] + y * turn[1, c] + z * turn[2, c]
        begin(dom, origins, directions, middle, zero, count, rays)
        narrow(dom, limits[tile, 0], limits[tile, 1], count, rays)
        _, evaluated = trace(net, dom, count, per_ray, stop_below, np.bool_(False), samples, rays)
        total += evaluated
        for r in range(count):
            pixel = tiles.pixel[start + r]
            for c in range(3):
                rgb[pixel, c] = level_of(shade(rays, r, c, background[c]))
            depth[pixel] = surface(rays, r) * (scale / tiles.length[start + r])
            opacity[pixel] = rays.opacity[r]
    return total
