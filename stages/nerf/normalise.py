"""Between a caller's rays and the field's: what every renderer shares."""

from __future__ import annotations

import numpy as np

from fieldpose.stages.nerf.metadata import Space


def normalised(space: Space, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Origins and unit directions (n, 3) in the field's coordinates, and the length of the directions there (n,)."""
    o = ((np.asarray(origins, np.float64) - space.centre) / space.scale).astype(np.float32)
    d = np.asarray(directions, np.float64) / space.scale
    length = np.linalg.norm(d, axis=1, keepdims=True)
    return o, (d / length).astype(np.float32), length[:, 0].astype(np.float32)


def by_object_rays(space: Space, jacobian: np.ndarray, unit: np.ndarray, length: np.ndarray) -> np.ndarray:
    """A jacobian (n, k, 6) by normalised origin and unit direction, turned into one by the caller's rays."""
    scale = np.float32(space.scale)
    by_unit = jacobian[..., 3:]
    along = np.sum(by_unit * unit[:, None], axis=-1, keepdims=True)
    by_direction = (by_unit - along * unit[:, None]) / (length[:, None, None] * scale)
    return np.concatenate([jacobian[..., :3] / scale, by_direction], axis=-1)
