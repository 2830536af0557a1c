"""Derivatives of what a camera sees by its motion, as a twist (translation 3, rotation 3)."""

from __future__ import annotations

import numpy as np

from fieldpose.stages.geometry.arrays import Jacobians2, Values


def image_jacobian(x: Values, y: Values, inverse_depth: Values) -> Jacobians2:
    """Derivatives of normalised image points (x, y) by the left twist of cam_from_object; depth is along the axis.

    Source: Chaumette and Hutchinson, Visual servo control, part I (2006), whose interaction matrix is by the camera's
    own velocity and so has the other sign.
    """
    zero = np.zeros_like(x)
    of_x = np.stack([inverse_depth, zero, -x * inverse_depth, -x * y, 1 + x * x, -y], axis=1)
    of_y = np.stack([zero, inverse_depth, -y * inverse_depth, -1 - y * y, x * y, x], axis=1)
    return np.stack([of_x, of_y], axis=1)


def twist_gradient(origins: np.ndarray, directions: np.ndarray, by_ray: np.ndarray) -> np.ndarray:
    """From derivatives (..., 6) by a ray's origin and direction (..., 3) to those by a twist that moves the ray.

    A twist (rho, phi) moves an origin o to o + rho + phi x o and turns a direction d to d + phi x d.
    """
    by_origin, by_direction = by_ray[..., :3], by_ray[..., 3:]
    by_turn = np.cross(origins, by_origin) + np.cross(directions, by_direction)
    return np.concatenate([by_origin, by_turn], axis=-1)
