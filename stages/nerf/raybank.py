"""All training pixels with their rays, in memory, to draw random batches from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fieldpose.stages.geometry import camera_centres
from fieldpose.stages.nerf.blocks import Blocks, View
from fieldpose.stages.nerf.metadata import Space
from fieldpose.stages.nerf.normalise import normalised_points


@dataclass(frozen=True)
class Batch:
    """Rays in the field's coordinates, unit directions, and their target colour over `background`; (n, 3) float32.

    block: the block (n,) of the bank that each is of.
    """

    origins: np.ndarray
    directions: np.ndarray
    target: np.ndarray
    background: np.ndarray
    block: np.ndarray


class RayBank:
    """Draws rays over the pixels of the views, more where `blocks` says that they are wrong."""

    def __init__(self, views: Sequence[View], space: Space):
        self.blocks = Blocks(views, space)
        sizes = [v.image.shape[0] * v.image.shape[1] for v in views]
        self._starts = np.concatenate([[0], np.cumsum(sizes)])
        self._pixels = np.concatenate([v.image.reshape(-1, v.image.shape[2]) for v in views])
        cameras = list(dict.fromkeys(v.camera for v in views))
        maps = [c.directions(c.grid()) for c in cameras]
        map_starts = np.concatenate([[0], np.cumsum([len(m) for m in maps])])
        self._directions = np.concatenate(maps)
        self._map_start = np.array([map_starts[cameras.index(v.camera)] for v in views])
        self._rotation = np.stack([space.turn @ v.cam_from_object[:3, :3].T for v in views]).astype(np.float32)
        centres = camera_centres(np.stack([v.cam_from_object for v in views]))
        self._origin = normalised_points(space, centres).astype(np.float32)
        self._background = views[0].background
        masked = any(v.learnt is not None for v in views)
        self._learnt = np.concatenate([_learnt(v) for v in views]) if masked else None

    def draw(self, rng: np.random.Generator, count: int) -> Batch:
        """A random batch; behind transparent pixels lies a random background, so that opacity is learnt.

        So it does behind opaque ones, of which then all has to be in the field, unless their background is known.
        """
        block, view, pixel = self.blocks.draw(rng, count)
        if self._learnt is not None:
            instead = nearest_before(self._learnt[self._starts[view] + pixel])
            block, view, pixel = block[instead], view[instead], pixel[instead]
        in_cam = self._directions[self._map_start[view] + pixel]
        directions = np.einsum("nij,nj->ni", self._rotation[view], in_cam)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        background = rng.random((count, 3), dtype=np.float32)
        if self._background is not None:
            background[:] = self._background
        colour = self._pixels[self._starts[view] + pixel].astype(np.float32) / 255
        target = colour[:, :3]
        if colour.shape[1] == 4:
            alpha = colour[:, 3:]
            target = target * alpha + (1 - alpha) * background
        return Batch(self._origin[view], directions, np.ascontiguousarray(target), background, block)


def nearest_before(good: np.ndarray) -> np.ndarray:
    """For each of (n,) bool the index of the last good one up to it; of the first good one where there is none."""
    if not good.any():
        return np.arange(len(good))
    found = np.maximum.accumulate(np.where(good, np.arange(len(good)), -1))
    return np.where(found < 0, good.argmax(), found)


def _learnt(view: View) -> np.ndarray:
    return np.ones(view.image.shape[:2], bool).ravel() if view.learnt is None else view.learnt.ravel()
