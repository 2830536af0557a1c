"""How far apart two poses are, measured against a limit in degrees and one in length."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from fieldpose.errors import ConfigError
from fieldpose.stages.geometry.arrays import Transform, Transforms
from fieldpose.stages.geometry.errors import rotation_error_deg, translation_error
from fieldpose.stages.geometry.rigid import camera_centres


@dataclass(frozen=True)
class Limit:
    """A neighbourhood of a pose: an angle in degrees and a distance of camera centres in object units."""

    angle_deg: float
    distance: float

    def __post_init__(self) -> None:
        if not (self.angle_deg >= 0 and self.distance >= 0):
            raise ConfigError(f"a limit of {self.angle_deg:g} degrees and {self.distance:g} must not be negative")

    def scaled(self, scale: float) -> Limit:
        """The limit whose distance is so many times larger: from shares of a length to object units."""
        return Limit(self.angle_deg, self.distance * scale)

    def distance_ratio(self, a: Transform, b: Transform) -> float:
        """How far apart two poses are in multiples of this limit, the worse of angle and distance."""
        angle = rotation_error_deg(a, b) / max(self.angle_deg, 1e-9)
        return max(angle, translation_error(a, b) / max(self.distance, 1e-12))

    def holds(self, a: Transform, b: Transform) -> bool:
        """Whether each of two poses lies in the other's neighbourhood."""
        return self.distance_ratio(a, b) <= 1.0


def pairwise(poses: Transforms, others: Float64[np.ndarray, "m 4 4"], limit: Limit) -> Float64[np.ndarray, "n m"]:
    """Limit.distance_ratio of every pose with every other."""
    rotations, other_rotations = poses[:, :3, :3], others[:, :3, :3]
    traces = np.einsum("nij,mij->nm", rotations, other_rotations)
    angles = np.rad2deg(np.arccos(np.clip((traces - 1) / 2, -1, 1)))
    centres, other_centres = camera_centres(poses), camera_centres(others)
    distances = np.linalg.norm(centres[:, None] - other_centres[None], axis=-1)
    return np.maximum(angles / max(limit.angle_deg, 1e-9), distances / max(limit.distance, 1e-12))
