"""The views of a training in blocks of pixels, and what is known of each: how wrong it is, how far what it shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from fieldpose.stages.geometry.cameras import Camera, scale_pixels
from fieldpose.stages.nerf.hull import Marked, seen_in
from fieldpose.stages.nerf.metadata import Space

SIDE = 4
"""Pixels along each side of a block: as few as are drawn often enough in a minute of training."""
REMEMBERED = 0.75
"""How much of a block's error is kept when one of its pixels is drawn."""
_HIDDEN = np.float32(1e-6)
LEAST, MOST = 0.5, 6.0
"""A block is drawn as often as LEAST + its error / the mean error, this at most MOST."""


@dataclass(frozen=True)
class View:
    """A posed image: uint8 (h, w, 3) or, with straight alpha, (h, w, 4).

    background: the colour in 0..1 that an opaque image has where nothing of the object is, if that is known. learnt:
    the pixels (h, w) bool that are to be learnt from, None for all.
    """

    name: str
    image: np.ndarray
    camera: Camera
    cam_from_object: np.ndarray
    background: tuple[float, float, float] | None = None
    learnt: np.ndarray | None = None


class Blocks:
    """Blocks of all views, one after the other, each view's row by row; there are `count`."""

    def __init__(self, views: Sequence[View], space: Space):
        self._views, self._scale = views, space.scale
        self._shape = np.array([v.image.shape[:2] for v in views])
        self._grid = -(-self._shape // SIDE)
        self._starts = np.concatenate([[0], np.cumsum(self._grid.prod(axis=1))])
        self.count = int(self._starts[-1])
        self.error, self.depth = np.zeros(self.count, np.float32), np.zeros(self.count, np.float32)
        self._learnt = np.concatenate([_any_learnt(v, grid) for v, grid in zip(views, self._grid, strict=True)])
        self._used = self._learnt.copy()
        self.reweigh()

    def use(self, space: Space, allowed: np.ndarray) -> None:
        """Draw from those blocks alone in which an `allowed` cell, (n, n, n) bool, can be seen."""
        cameras = [(self._camera(i), v.cam_from_object) for i, v in enumerate(self._views)]
        self._used = self._learnt & np.concatenate([seen.ravel() for seen in seen_in(cameras, space, allowed)])
        self.reweigh()

    def reweigh(self) -> None:
        """Draw blocks by their errors from now on."""
        mean = self.mean_error
        excess = np.minimum(self.error / mean, MOST) if mean > 0 else 0.0
        self._cumulative = np.cumsum(np.where(self._used, LEAST + excess, 0.0))

    @property
    def mean_error(self) -> float:
        """Squared error of a pixel, its channels summed, in the mean over the blocks that are drawn from."""
        return float(self.error[self._used].mean()) if self._used.any() else 0.0

    def draw(self, rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Blocks, the views that they are of, and a row-major pixel in each: (count,) int64, in the blocks' order."""
        at = (np.arange(count) + rng.random(count)) * (self._cumulative[-1] / max(count, 1))
        block = np.minimum(np.searchsorted(self._cumulative, at, side="right"), self.count - 1)
        view = np.searchsorted(self._starts, block, side="right") - 1
        row, column = np.divmod(block - self._starts[view], self._grid[view, 1])
        height, width = self._shape[view].T
        y = SIDE * row + (rng.random(count) * np.minimum(SIDE, height - SIDE * row)).astype(np.int64)
        x = SIDE * column + (rng.random(count) * np.minimum(SIDE, width - SIDE * column)).astype(np.int64)
        return block, view, y * width + x

    def learnt(self, block: np.ndarray, errors: np.ndarray, depths: np.ndarray) -> None:
        """Take in the squared errors of pixels of blocks and the distances, in the field's coordinates, seen there."""
        self.error[block] = REMEMBERED * self.error[block] + np.float32(1 - REMEMBERED) * errors
        self.depth[block] = depths

    @property
    def views(self) -> int:
        """How many there are."""
        return len(self._views)

    def wrong(self, limit: float, views: np.ndarray) -> list[Marked]:
        """Some of the views with a block as a pixel, those marked whose error is above the limit."""
        result = []
        for i in views:
            view = self._views[i]
            part, shape = slice(self._starts[i], self._starts[i + 1]), tuple(self._grid[i])
            # What is not learnt from is not judged by: as if something stood before the lens.
            depth = np.where(self._learnt[part], self.depth[part] * np.float32(self._scale), _HIDDEN).reshape(shape)
            result.append(
                Marked((self.error[part] > limit).reshape(shape), self._camera(i), view.cam_from_object, depth)
            )
        return result

    def _camera(self, index: int) -> Camera:
        """The view's camera with a block as a pixel; the last ones of a row may reach beyond the image."""
        camera, (rows, columns) = self._views[index].camera, self._grid[index]
        return msgspec.structs.replace(
            camera, width=int(columns), height=int(rows), fx=camera.fx / SIDE, fy=camera.fy / SIDE,
            cx=scale_pixels(camera.cx, 1 / SIDE), cy=scale_pixels(camera.cy, 1 / SIDE),
        )  # fmt: skip


def _any_learnt(view: View, grid: np.ndarray) -> np.ndarray:
    """Which of a view's blocks, (rows * columns,) bool, have a pixel that is to be learnt from."""
    rows, columns = (int(side) for side in grid)
    if view.learnt is None:
        return np.ones(rows * columns, bool)
    whole = np.zeros((rows * SIDE, columns * SIDE), bool)
    whole[: view.learnt.shape[0], : view.learnt.shape[1]] = view.learnt
    return whole.reshape(rows, SIDE, columns, SIDE).any(axis=(1, 3)).ravel()
