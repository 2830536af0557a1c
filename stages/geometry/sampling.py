"""Random poses near a given one."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from fieldpose.stages.geometry.arrays import Transform, Vector
from fieldpose.stages.geometry.rigid import from_rotation, inverse, rotation_about


def perturb(
    cam_from_object: Transform,
    rng: np.random.Generator,
    angle_deg: tuple[float, float] = (10.0, 40.0),
    max_translation: float = 0.2,
    centre: ArrayLike = (0.0, 0.0, 0.0),
) -> Transform:
    """A guess for a pose as in the paper's section V-B: move the camera, cam_from_object in and out.

    The camera is turned about a random axis through `centre` (object coordinates) by an angle within `angle_deg`,
    then shifted in a random direction by up to `max_translation`, both uniform.
    """
    centre = np.asarray(centre, dtype=np.float64)
    turn = rotation_about(random_direction(rng), np.deg2rad(rng.uniform(*angle_deg)))
    shift = random_direction(rng) * rng.uniform(0.0, max_translation)
    about_centre = from_rotation(turn[:3, :3], centre - turn[:3, :3] @ centre + shift)
    return inverse(about_centre @ inverse(cam_from_object))


def random_direction(rng: np.random.Generator) -> Vector:
    """A unit vector, uniform over the sphere."""
    vector = rng.standard_normal(3)
    return vector / np.linalg.norm(vector)
