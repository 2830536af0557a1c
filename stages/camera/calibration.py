"""Which camera took an image: from a file, from the training views, from what the image says, or assumed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from fieldpose.bus.messages import CameraOrigin
from fieldpose.errors import SourceError
from fieldpose.stages.camera.camera_files import read_camera_file
from fieldpose.stages.camera.config import CameraConfig
from fieldpose.stages.geometry import Camera
from fieldpose.stages.nerf.datasets.images import load_photo, orientation, probe, upright, upright_size

_EXIF_IFD = 0x8769
_FOCAL_LENGTH_35MM = 0xA405
_DIAGONAL_35MM = math.hypot(36.0, 24.0)
_LONGEST_MM = 1e4
_ASPECT_TOLERANCE = 0.01
ONE_LENS = 1.2
"""Focal lengths that differ by more are not those of one lens: fitted ones differ from EXIF's by a few percent, a
phone's lenses from each other by half and more."""


@dataclass(frozen=True)
class Calibration:
    """The camera of an image, where it was taken from, and that in words."""

    camera: Camera
    origin: CameraOrigin
    told: str


class Calibrator:
    """Finds the camera of images; `known` are the cameras of the field's training views."""

    def __init__(self, config: CameraConfig, known: Sequence[Camera] = ()) -> None:
        self._config, self._known = config, known

    def of(self, width: int, height: int, image: Path | None = None) -> Calibration:
        """The camera of an image of that size, and maybe with a file.

        In this order: config.camera_file; the training views' camera where the shape is theirs, unless EXIF tells of
        another lens; EXIF; config.fov_deg. Raises SourceError if the camera file cannot be used, or is of images of
        another shape.
        """
        path = self._config.camera_file
        if path is not None:
            fitted = _fitted(read_camera_file(path), width, height, path)
            return Calibration(fitted, CameraOrigin.CALIBRATED, f"calibration from {path}")
        focal = None if image is None else focal_length_from_exif(image, width, height)
        trained = self._trained(width, height)
        if trained is not None and (focal is None or _alike(focal, trained.fx)):
            return Calibration(trained, CameraOrigin.TRAINING, "the camera of the training views")
        if focal is not None:
            return Calibration(_centred(width, height, focal), CameraOrigin.EXIF, "focal length from EXIF")
        fov_deg = self._config.fov_deg
        focal = 0.5 * max(width, height) / math.tan(math.radians(fov_deg) / 2)
        told = f"assumed field of view of {fov_deg:g} degrees; give --camera.camera-file"
        return Calibration(_centred(width, height, focal), CameraOrigin.ASSUMED, told)

    def photo(self, path: Path) -> tuple[np.ndarray, Calibration]:
        """The pixels (h, w, 3) uint8 of a photograph and its camera. Raises DatasetError and SourceError as of() does.

        It is turned as its EXIF says, unless it has the shape of a known camera only as it is stored, as photographs do
        whose poses were found without a look at that.
        """
        image = upright(path) if self.turns(path) else load_photo(path)
        return image, self.of(image.shape[1], image.shape[0], path)

    def turns(self, path: Path) -> bool:
        """Whether photo() turns that photograph. Raises DatasetError and SourceError."""
        if orientation(path) == 1:
            return False
        header, turned = probe(path), upright_size(path)
        return self._fits(*turned) or not self._fits(header.width, header.height)

    def _fits(self, width: int, height: int) -> bool:
        file = self._config.camera_file
        cameras = self._known if file is None else (read_camera_file(file),)
        return any(_same_shape(camera, width, height) for camera in cameras)

    def _trained(self, width: int, height: int) -> Camera | None:
        """The training camera of that shape, at that size; of several the one of median focal length."""
        shaped = [camera.resized(width, height) for camera in self._known if _same_shape(camera, width, height)]
        return sorted(shaped, key=lambda camera: camera.fx)[len(shaped) // 2] if shaped else None


def focal_length_from_exif(path: Path, width: int, height: int) -> float | None:
    """In pixels, from the 35 mm equivalent, which is defined by the diagonal; None where the file has none."""
    try:
        with Image.open(path) as image:
            stated = image.getexif().get_ifd(_EXIF_IFD).get(_FOCAL_LENGTH_35MM)
            focal_mm = float(stated or 0)
    except Exception:  # Pillow does not tell what damaged EXIF raises
        return None
    return focal_mm / _DIAGONAL_35MM * math.hypot(width, height) if 0 < focal_mm < _LONGEST_MM else None


def _centred(width: int, height: int, focal: float) -> Camera:
    return Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def _fitted(camera: Camera, width: int, height: int, path: Path) -> Camera:
    if not _same_shape(camera, width, height):
        raise SourceError(
            f"{path}: is of {camera.width}x{camera.height} images, but these are {width}x{height}, another shape"
        )
    return camera.resized(width, height)


def _same_shape(camera: Camera, width: int, height: int) -> bool:
    return abs(camera.width * height - camera.height * width) <= _ASPECT_TOLERANCE * camera.width * height


def _alike(focal: float, other: float) -> bool:
    return max(focal, other) <= ONE_LENS * min(focal, other)
