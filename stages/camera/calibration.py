"""Which camera took an image: from a file, from what the image says of itself, or from an assumed field of view."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import msgspec
from PIL import Image

from fieldpose.bus.messages import CameraModel
from fieldpose.stages.camera.config import CameraConfig
from fieldpose.stages.errors import SourceError, StageError
from fieldpose.stages.geometry import Camera
from fieldpose.stages.wire import camera_of

_EXIF_IFD = 0x8769
_FOCAL_LENGTH_35MM = 0xA405
_DIAGONAL_35MM = math.hypot(36.0, 24.0)
_ASPECT_TOLERANCE = 0.01


@dataclass(frozen=True)
class Calibration:
    """The camera of an image, and where it was taken from."""

    camera: Camera
    origin: str


def calibrate(config: CameraConfig, width: int, height: int, image: Path | None = None) -> Calibration:
    """The camera of an image of that size: config.camera_file, else the image file's EXIF, else config.fov_deg.

    Raises SourceError if the camera file cannot be used, or is of images of another shape.
    """
    if config.camera_file is not None:
        stated = read_camera_file(config.camera_file)
        return Calibration(
            _fitted(stated, width, height, config.camera_file), f"calibration from {config.camera_file}"
        )
    focal = None if image is None else focal_length_from_exif(image, width, height)
    if focal is not None:
        return Calibration(_centred(width, height, focal), "focal length from EXIF")
    focal = 0.5 * max(width, height) / math.tan(math.radians(config.fov_deg) / 2)
    return Calibration(_centred(width, height, focal), f"assumed field of view of {config.fov_deg:g} degrees")


def read_camera_file(path: Path) -> Camera:
    """Read a JSON file of width, height, fx, fy, cx, cy and, if there is any, distortion. Raises SourceError."""
    try:
        return camera_of(msgspec.json.decode(path.read_bytes(), type=CameraModel))
    except FileNotFoundError:
        raise SourceError(f"{path}: no such camera file") from None
    except (OSError, msgspec.DecodeError, StageError) as error:
        raise SourceError(
            f"{path}: no usable camera file ({error}); it needs width, height, fx, fy, cx, cy in pixels, and may"
            " have distortion as [k1, k2, p1, p2, k3]"
        ) from error


def focal_length_from_exif(path: Path, width: int, height: int) -> float | None:
    """In pixels, from the 35 mm equivalent, which is defined by the diagonal; None where the file has none."""
    try:
        with Image.open(path) as image:
            stated = image.getexif().get_ifd(_EXIF_IFD).get(_FOCAL_LENGTH_35MM)
            focal_mm = float(stated or 0)
    except (OSError, ValueError, TypeError, SyntaxError):
        return None
    return focal_mm / _DIAGONAL_35MM * math.hypot(width, height) if focal_mm > 0 else None


def _centred(width: int, height: int, focal: float) -> Camera:
    return Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def _fitted(camera: Camera, width: int, height: int, path: Path) -> Camera:
    if abs(camera.width * height - camera.height * width) > _ASPECT_TOLERANCE * camera.width * height:
        raise SourceError(
            f"{path}: is of {camera.width}x{camera.height} images, but these are {width}x{height}, another shape"
        )
    return camera.resized(width, height)
