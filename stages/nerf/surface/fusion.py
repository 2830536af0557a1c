"""From views of depth to the surface: their truncated signed distances averaged, and where the average is 0.

Source: Curless and Levoy, A volumetric method for building complex models from range images (SIGGRAPH 1996). Distances
are measured to the plane through what a pixel sees; a view says the less of a place the farther that is behind what it
sees (Bylow et al., Real-time camera tracking and 3D reconstruction using signed distance functions, RSS 2013), so that
thin parts keep both of their sides.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from fieldpose.stages.nerf.surface.kernels import DepthViews, fuse
from fieldpose.stages.nerf.surface.marching import Piece, isosurface, joined
from fieldpose.stages.nerf.surface.views import seen_by

BLOCK = 16
"""Cells along each side of a block: the grid is kept only where surface is seen, and only while it is worked on."""
REACH = 2.0
"""Cells before and behind a surface in which distances are averaged. With more, thin parts become thicker, and false
sheets lie behind outlines."""
_BATCH = 64


@dataclass(frozen=True)
class Grid:
    """Cells of one size from `low` (3,) on, `blocks` (3,) blocks of 16 along x, y and z."""

    low: np.ndarray
    cell: float
    blocks: np.ndarray

    @property
    def nodes(self) -> tuple[int, int, int]:
        """Along x, y and z."""
        x, y, z = (int(n) * BLOCK + 1 for n in self.blocks)
        return x, y, z


def grid_over(region: np.ndarray, resolution: int) -> Grid:
    """A grid over a box (2, 3) and as far beyond as distances reach; `resolution` cells along its longest side."""
    cell = float((region[1] - region[0]).max()) / resolution
    low = region[0] - REACH * cell
    cells = np.ceil((region[1] - region[0]) / cell + 2 * REACH - 1e-6)
    return Grid(low, cell, np.ceil(cells / BLOCK).astype(np.int64))


def fused(views: DepthViews, grid: Grid, threads: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) float64 in object coordinates and triangles (m, 3) int64, outside towards the views.

    The surface is open where no view has looked. Where views of one outline see past what others see before it, it has
    sheets that nobody sees: see `agreed`.
    """
    batches = _batches(np.argwhere(_seen_blocks(views, grid)))
    with ThreadPoolExecutor(threads) as pool:
        pieces = list(pool.map(lambda batch: _piece(views, grid, batch), batches))
    vertices, triangles = joined(pieces)
    return grid.low + grid.cell * vertices, triangles


def _batches(blocks: np.ndarray) -> Iterator[np.ndarray]:
    return (blocks[i : i + _BATCH, ::-1] * BLOCK for i in range(0, len(blocks), _BATCH))


def _piece(views: DepthViews, grid: Grid, starts: np.ndarray) -> Piece:
    starts = np.ascontiguousarray(starts)
    value = np.empty((len(starts), *3 * (BLOCK + 1,)), np.float32)
    weight = np.empty_like(value)
    cell, reach = np.float32(grid.cell), np.float32(REACH * grid.cell)
    fuse(views, starts, grid.low.astype(np.float32), cell, reach, value, weight)
    return isosurface(value, weight > 0, starts, grid.nodes)


def _seen_blocks(views: DepthViews, grid: Grid) -> np.ndarray:
    """(z, y, x) bool: blocks within reach of what a view sees."""
    seen = np.zeros(grid.blocks[::-1], bool)
    for v in range(len(views.depth)):
        points = seen_by(views, v).points
        for side in itertools.product((-1, 1), repeat=3):
            block = np.floor((points - grid.low + REACH * grid.cell * np.array(side)) / (BLOCK * grid.cell))
            inside = ((block >= 0) & (block < grid.blocks)).all(axis=1)
            x, y, z = block[inside].astype(np.int64).T
            seen[z, y, x] = True
    return seen
