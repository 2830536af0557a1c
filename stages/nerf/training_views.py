"""The views that a field was learnt from: poses to fall back on, and what they look like."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fieldpose.errors import ConfigError
from fieldpose.stages.geometry import camera_centres
from fieldpose.stages.nerf.datasets import find_name
from fieldpose.stages.nerf.metadata import DESCRIBED_SIZE

if TYPE_CHECKING:
    from fieldpose.stages.nerf.field import Field


@dataclass(frozen=True)
class TrainingViews:
    """The views that a field was learnt from: names, cam_from_object (n, 4, 4), and how they look, if that is known.

    descriptors: (n, keypoints, 64) int8, as stages.retrieval makes them of images whose longer side is `size`.
    error_scale: how many times larger the errors of poses found next to them are than the covariances say.
    """

    names: tuple[str, ...]
    cam_from_object: np.ndarray
    descriptors: np.ndarray | None = None
    size: int = DESCRIBED_SIZE
    error_scale: float = 1.0

    @property
    def scale(self) -> float:
        """The spread of the cameras (median distance to their mean) in object units; 1 for fewer than two."""
        if len(self.cam_from_object) < 2:
            return 1.0
        centres = camera_centres(self.cam_from_object)
        spread = float(np.median(np.linalg.norm(centres - centres.mean(axis=0), axis=1)))
        return spread if spread > 1e-9 else 1.0

    def pose_of(self, name: str) -> np.ndarray:
        """cam_from_object of the view of that name, as find_name finds it. DatasetError or ConfigError if none."""
        if not self.names:
            raise ConfigError(f"the field does not tell its training views, so train:{name} means nothing")
        return self.cam_from_object[self.names.index(find_name(list(self.names), name))]


def training_views(field: Field) -> TrainingViews:
    """The training views that a field tells of."""
    cameras = field.metadata.cameras
    poses = [camera.pose for camera in cameras]
    names = tuple(camera.name for camera in cameras)
    largest = max((max(camera.width, camera.height) for camera in cameras), default=DESCRIBED_SIZE)
    accuracy = field.metadata.accuracy
    return TrainingViews(
        names, np.array(poses, dtype=np.float64).reshape(-1, 4, 4), field.descriptors, min(largest, DESCRIBED_SIZE),
        (field.metadata.error_scale or 1.0) if accuracy is None else accuracy.error_scale,
    )  # fmt: skip
