"""Changes of frame and unit at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fieldpose.stages.geometry.arrays import Matrix3, Points64, Transforms, Vector
from fieldpose.stages.geometry.rigid import camera_centres


@dataclass(frozen=True, eq=False)
class Similarity:
    """target_from_source: x -> scale * rotation @ x + translation."""

    scale: float
    rotation: Matrix3
    translation: Vector

    def of_poses(self, cam_from_source: Transforms) -> Transforms:
        """cam_from_target (n, 4, 4), the same cameras: they stand where they stood in what was moved along."""
        moved = cam_from_source.copy()
        moved[:, :3, :3] = cam_from_source[:, :3, :3] @ self.rotation.T
        centres = self.scale * camera_centres(cam_from_source) @ self.rotation.T + self.translation
        moved[:, :3, 3] = -np.einsum("nij,nj->ni", moved[:, :3, :3], centres)
        return moved

    def of_points(self, points: Points64) -> Points64:
        """Points (n, 3) of the source in the target's coordinates."""
        return self.scale * points @ self.rotation.T + self.translation

    def after(self, first: Similarity) -> Similarity:
        """What `first`, and then this one does."""
        moved = self.scale * self.rotation @ first.translation + self.translation
        return Similarity(self.scale * first.scale, self.rotation @ first.rotation, moved)

    def inverse(self) -> Similarity:
        """source_from_target."""
        back = self.rotation.T
        return Similarity(1 / self.scale, back, -back @ self.translation / self.scale)

    @classmethod
    def identity(cls) -> Similarity:
        """What changes nothing."""
        return cls(1.0, np.eye(3), np.zeros(3))
