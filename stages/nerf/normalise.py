"""Between a caller's rays and the field's: what every renderer shares."""

from __future__ import annotations

import numpy as np

from fieldpose.stages.nerf.metadata import Space


def normalised(space: Space, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Origins and unit directions (n, 3) in the field's coordinates, and the length of the directions there (n,)."""
    o = normalised_points(space, origins).astype(np.float32)
    d = np.asarray(directions, np.float64) @ space.turn.T / space.scale
    length = np.linalg.norm(d, axis=1, keepdims=True)
    return o, (d / length).astype(np.float32), length[:, 0].astype(np.float32)


def normalised_points(space: Space, points: np.ndarray) -> np.ndarray:
    """Object coordinates (..., 3) in the field's, float64."""
    centred: np.ndarray = np.asarray(points, np.float64) - space.centre
    return centred @ space.turn.T / space.scale


def object_points(space: Space, normalised: np.ndarray) -> np.ndarray:
    """The field's coordinates (..., 3) in the object's, float64."""
    turned: np.ndarray = np.asarray(normalised, np.float64) @ space.turn
    return turned * space.scale + np.array(space.centre)


def by_object_rays(space: Space, jacobian: np.ndarray, unit: np.ndarray, length: np.ndarray) -> np.ndarray:
    """A jacobian (n, k, 6) by normalised origin and unit direction, turned into one by the caller's rays."""
    scale, turn = np.float32(space.scale), space.turn.astype(np.float32)
    by_unit = jacobian[..., 3:]
    along = np.sum(by_unit * unit[:, None], axis=-1, keepdims=True)
    by_direction = (by_unit - along * unit[:, None]) / (length[:, None, None] * scale)
    return np.concatenate([jacobian[..., :3] @ turn / scale, by_direction @ turn], axis=-1)
