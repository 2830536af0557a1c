"""The cameras of a set of photographs, with their poses."""

from __future__ import annotations

from dataclasses import dataclass

from fieldpose.stages.geometry import Camera
from fieldpose.stages.geometry.arrays import Flags, Transforms


@dataclass(frozen=True, eq=False)
class PosedCameras:
    """One camera and one cam_from_object (n, 4, 4) an image; images of one camera have equal ones."""

    cameras: tuple[Camera, ...]
    cam_from_object: Transforms

    def __len__(self) -> int:
        return len(self.cameras)

    def chosen(self, images: Flags) -> PosedCameras:
        """Those of the flagged images."""
        cameras = tuple(camera for camera, kept in zip(self.cameras, images, strict=True) if kept)
        return PosedCameras(cameras, self.cam_from_object[images])
