"""All training pixels with their rays, in memory, to draw random batches from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fieldpose.stages.geometry.cameras import Camera
from fieldpose.stages.nerf.metadata import Space


@dataclass(frozen=True)
class View:
    """A posed image: uint8 (h, w, 3) or, with straight alpha, (h, w, 4)."""

    name: str
    image: np.ndarray
    camera: Camera
    cam_from_object: np.ndarray


@dataclass(frozen=True)
class Batch:
    """Rays in the field's coordinates, unit directions, and their target colour over `background`; (n, 3) float32."""

    origins: np.ndarray
    directions: np.ndarray
    target: np.ndarray
    background: np.ndarray


class RayBank:
    """Draws rays uniformly over all pixels of the views."""

    def __init__(self, views: list[View], space: Space):
        sizes = [v.image.shape[0] * v.image.shape[1] for v in views]
        self._starts = np.concatenate([[0], np.cumsum(sizes)])
        self._pixels = np.concatenate([v.image.reshape(-1, v.image.shape[2]) for v in views])
        cameras = list(dict.fromkeys(v.camera for v in views))
        maps = [c.directions(c.grid()) for c in cameras]
        map_starts = np.concatenate([[0], np.cumsum([len(m) for m in maps])])
        self._directions = np.concatenate(maps)
        self._map_start = np.array([map_starts[cameras.index(v.camera)] for v in views])
        self._rotation = np.stack([v.cam_from_object[:3, :3].T for v in views]).astype(np.float32)
        centres = np.stack([-v.cam_from_object[:3, :3].T @ v.cam_from_object[:3, 3] for v in views])
        self._origin = ((centres - np.array(space.centre)) / space.scale).astype(np.float32)

    def draw(self, rng: np.random.Generator, count: int) -> Batch:
        """A random batch; behind transparent pixels lies a random background, so that opacity is learnt."""
        flat = rng.integers(0, len(self._pixels), count)
        image = np.searchsorted(self._starts, flat, side="right") - 1
        in_cam = self._directions[self._map_start[image] + flat - self._starts[image]]
        directions = np.einsum("nij,nj->ni", self._rotation[image], in_cam)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        background = rng.random((count, 3), dtype=np.float32)
        colour = self._pixels[flat].astype(np.float32) / 255
        target = colour[:, :3]
        if colour.shape[1] == 4:
            alpha = colour[:, 3:]
            target = target * alpha + (1 - alpha) * background
        return Batch(self._origin[image], directions, np.ascontiguousarray(target), background)
