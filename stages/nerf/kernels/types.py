"""Arrays that the kernels share, as named tuples that numba passes without copying."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

SH_SIZE = 16
BLOCK = 4
"""Cells along each side of a block of the occupancy grid."""


class Net(NamedTuple):
    """Learnt parameters (float32) and the layout of the hash grid (int64, one entry a level)."""

    table: np.ndarray  # (entries, level_features); float32, or the bits of float16 for rendering
    w1: np.ndarray  # (levels * level_features, hidden)
    w2: np.ndarray  # (hidden, 1 + features)
    c1: np.ndarray  # (features + SH_SIZE, colour_hidden)
    c2: np.ndarray  # (colour_hidden, colour_hidden)
    c3: np.ndarray  # (colour_hidden, 3)
    offsets: np.ndarray
    resolutions: np.ndarray
    masks: np.ndarray  # table size - 1 of a hashed level, -1 of a dense one


class Domain(NamedTuple):
    """Where the field lives, in normalised coordinates, and what of it is occupied."""

    contracted: bool
    boxed: bool  # whether rays are clipped to a box; always where not contracted
    low: np.ndarray  # (3,) its lowest corner
    high: np.ndarray  # (3,) its highest corner
    step: float  # step length, before the growth with distance of contracted space
    near: float
    far: float
    bits: np.ndarray  # occupancy, one bit a cell, x fastest
    distance: np.ndarray  # for each block of 4 x 4 x 4 cells, how many blocks away the nearest occupied one is
    resolution: int


class Samples(NamedTuple):
    """Everything about the samples of a packet of rays; rows are in order of evaluation."""

    y: np.ndarray  # (n, 3) position, normalised coordinates
    u: np.ndarray  # (3, n and a vector) position in the unit cube of the grid
    t: np.ndarray  # (n,) distance along the ray
    dt: np.ndarray  # (n,)
    ray: np.ndarray  # (n,) index in the packet
    previous: np.ndarray  # (n,) row of the same ray's previous sample, -1 for its first
    x: np.ndarray  # (n, levels * level_features) encoding
    h: np.ndarray  # (n, hidden) after the activation
    out: np.ndarray  # (n, 1 + features) network output
    weight: np.ndarray  # (n,) compositing weight
    trans: np.ndarray  # (n,) transmittance after the sample
    dx: np.ndarray  # (n, levels * level_features) gradients, same shapes
    dh: np.ndarray
    dout: np.ndarray
    corner_rows: np.ndarray  # scratch of encoding.plan
    corner_weights: np.ndarray


class Rays(NamedTuple):
    """State of the rays of a packet."""

    lines: np.ndarray  # (9, r) origin, unit direction, and 1 / direction in blocks of the occupancy grid
    t: np.ndarray
    far: np.ndarray
    trans: np.ndarray
    last: np.ndarray  # row of the ray's newest sample, -1 without
    alive: np.ndarray
    sums: np.ndarray  # (r, 1 + features) weighted sums of the samples' outputs
    feats: np.ndarray  # (r, features + SH_SIZE) composited features, then the direction's harmonics
    opacity: np.ndarray
    depth: np.ndarray  # weighted mean of the samples' distances, not divided by the opacity
    median: np.ndarray  # distance at which half of the light is stopped, 0 where it is not
    h1: np.ndarray
    h2: np.ndarray
    rgb: np.ndarray  # (r, 3) view-dependent part
    dfeats: np.ndarray
    dh1: np.ndarray
    dh2: np.ndarray
    drgb: np.ndarray
    dopacity: np.ndarray
    ddepth: np.ndarray


class Tiles(NamedTuple):
    """A camera's rays tile by tile, row by row of tiles, so that rays traced together read the same table entries."""

    first: np.ndarray  # (tiles + 1,) where each tile's rays begin among the n, and their end
    pixel: np.ndarray  # (n,) row-major pixel index
    unit: np.ndarray  # (n, 3) direction in the camera
    length: np.ndarray  # (n,) of the direction with z = 1
