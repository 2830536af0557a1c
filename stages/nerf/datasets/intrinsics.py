"""From the intrinsics of a JSON file, in their many spellings, to a Camera."""

from __future__ import annotations

import math
from pathlib import Path

import msgspec
import numpy as np

from fieldpose.errors import DatasetError, GeometryError
from fieldpose.stages.geometry.cameras import Camera
from fieldpose.stages.nerf.datasets.images import ImageHeader, probe

_ASPECT_TOLERANCE = 0.01
_NARROWEST_DEG, _WIDEST_DEG = 1.0, 170.0
"""Of a photograph: the longest tele lenses see 2 degrees, and a pinhole camera's images are useless beyond 150."""
PINHOLE_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "PERSPECTIVE")


class Intrinsics(msgspec.Struct, kw_only=True):
    """Of a whole file or of one frame; angles are full fields of view in radians."""

    w: float | None = None
    h: float | None = None
    fl_x: float | None = None
    fl_y: float | None = None
    cx: float | None = None
    cy: float | None = None
    k1: float | None = None
    k2: float | None = None
    k3: float | None = None
    k4: float | None = None
    p1: float | None = None
    p2: float | None = None
    camera_angle_x: float | None = None
    camera_angle_y: float | None = None
    camera_model: str | None = None
    is_fisheye: bool | None = None


def camera_of(document: Intrinsics, frame: Intrinsics, header: ImageHeader, pixel_centre: float, where: str) -> Camera:
    """The camera of one frame: its own numbers first, the file's next, a centred principal point last.

    pixel_centre: the coordinate that the file gives to the centre of the first pixel (COLMAP's is 0.5).
    DatasetError if there is no focal length, or the model is not a pinhole with OpenCV's distortion.
    """
    _check_model(document, frame, where)
    if _stated(document, frame, "k4"):
        raise DatasetError(f"{where}: k4 belongs to a fisheye lens; undistort the images to a pinhole camera first")
    fx, fy = _focal_lengths(document, frame, header, where)
    cx, cy = _stated(document, frame, "cx"), _stated(document, frame, "cy")
    cx = header.width / 2 - 0.5 if cx is None else cx - pixel_centre
    cy = header.height / 2 - 0.5 if cy is None else cy - pixel_centre
    k1, k2, p1, p2, k3 = (_stated(document, frame, name) or 0.0 for name in ("k1", "k2", "p1", "p2", "k3"))
    return checked_camera(where, header.width, header.height, (fx, fy), (cx, cy), (k1, k2, p1, p2, k3))


def checked_camera(
    where: str,
    width: int,
    height: int,
    focal: tuple[float, float],
    principal: tuple[float, float],
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0),
) -> Camera:
    """A camera of photographs; (0, 0) is the centre of the first pixel. DatasetError if the numbers make none."""
    try:
        camera = Camera(width, height, *focal, *principal, distortion)
        check_invertible(camera)
        _check_field_of_view(camera)
    except GeometryError as error:
        raise DatasetError(f"{where}: {error}") from error
    return camera


def fitted(path: Path, camera: Camera) -> Camera:
    """The camera at the size of an image's file, which may have been shrunk since. DatasetError for another shape."""
    header = probe(path)
    if (header.width, header.height) == (camera.width, camera.height):
        return camera
    if not same_shape(header, camera.width, camera.height):
        raise DatasetError(
            f"{path}: the image has {header.width}x{header.height} pixels, its camera {camera.width}x{camera.height},"
            " another shape; restore the images that the camera is of"
        )
    return camera.resized(header.width, header.height)


def same_shape(header: ImageHeader, width: int, height: int) -> bool:
    """Whether an image is one of (width, height) resized, but for the rounding of its sides."""
    return abs(width * header.height - height * header.width) <= _ASPECT_TOLERANCE * width * header.height


def _stated(document: Intrinsics, frame: Intrinsics, name: str) -> float | None:
    own = getattr(frame, name)
    return own if own is not None else getattr(document, name)


def _check_model(document: Intrinsics, frame: Intrinsics, where: str) -> None:
    model = frame.camera_model or document.camera_model or "OPENCV"
    fisheye = frame.is_fisheye if frame.is_fisheye is not None else document.is_fisheye
    if fisheye or model.upper() not in PINHOLE_MODELS:
        what = "is_fisheye" if fisheye else f"camera_model {model}"
        raise DatasetError(
            f"{where}: {what} is not supported; undistort the images to a pinhole camera (OPENCV or PINHOLE) first"
        )


def _focal_lengths(document: Intrinsics, frame: Intrinsics, header: ImageHeader, where: str) -> tuple[float, float]:
    for source in (frame, document):
        fx = _focal_length(source.fl_x, source.camera_angle_x, header.width, where)
        if fx is not None:
            return fx, _focal_length(source.fl_y, source.camera_angle_y, header.height, where) or fx
    raise DatasetError(f"{where}: no focal length; the file needs fl_x or camera_angle_x")


def _focal_length(focal: float | None, angle: float | None, pixels: int, where: str) -> float | None:
    if focal is not None:
        return focal
    if angle is None:
        return None
    if not 0 < angle < math.pi:
        raise DatasetError(f"{where}: camera_angle must lie between 0 and pi radians, got {angle}")
    return 0.5 * pixels / math.tan(0.5 * angle)


def _check_field_of_view(camera: Camera) -> None:
    for focal, pixels, name in ((camera.fx, camera.width, "across"), (camera.fy, camera.height, "down")):
        angle = math.degrees(2 * math.atan(pixels / 2 / focal))
        if not _NARROWEST_DEG <= angle <= _WIDEST_DEG:
            raise GeometryError(
                f"a focal length of {focal:g} px sees {angle:.3g} degrees {name} {pixels} px; is it of these images,"
                " and in pixels?"
            )


def check_invertible(camera: Camera) -> None:
    """GeometryError for a lens that folds its image's corners over it."""
    if camera.is_distorted:
        right, bottom = camera.width - 0.5, camera.height - 0.5
        corners = np.array([(-0.5, -0.5), (right, -0.5), (-0.5, bottom), (right, bottom)])
        with np.errstate(over="ignore", invalid="ignore"):
            camera.directions(corners)
