"""COLMAP's model files, read here: its own reader takes as much memory as a damaged count says, or ends the process.

Source: COLMAP's documentation, Output Format; its first pixel has its centre at 0.5.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fieldpose.errors import GeometryError
from fieldpose.stages.geometry import Camera
from fieldpose.stages.geometry.rigid import from_rotation

_CENTRE = 0.5
_MODELS = (
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV",
    "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE",
)  # fmt: skip
"""By their numbers in binary files."""
_PERSPECTIVE = {"SIMPLE_PINHOLE": (1, 0), "PINHOLE": (2, 0), "SIMPLE_RADIAL": (1, 1), "RADIAL": (1, 2),
                "OPENCV": (2, 4), "FULL_OPENCV": (2, 8)}  # fmt: skip
"""Focal lengths and coefficients; the principal point stands between."""
_POINT_BYTES = 24
_LARGEST = 1e15


@dataclass(frozen=True, eq=False)
class ModelImage:
    """An image of a COLMAP model: its name there, its camera, and its cam_from_world (4, 4)."""

    name: str
    camera: Camera
    cam_from_world: np.ndarray


def read_model(folder: Path) -> list[ModelImage]:
    """The posed images of a model, binary or text, sorted by name. Raises GeometryError for what is no such model.

    Lenses are those of OpenCV's perspective camera with up to five coefficients; others are refused by name.
    """
    binary = (folder / "cameras.bin").is_file() and (folder / "images.bin").is_file()
    read_cameras, read_images = (_cameras_bin, _images_bin) if binary else (_cameras_txt, _images_txt)
    try:
        cameras = {camera[0]: _camera(folder, *camera) for camera in read_cameras(folder)}
        images = [
            ModelImage(name, cameras[number], _pose(values)) for name, number, values in read_images(folder)
        ]  # fmt: skip
    except GeometryError:
        raise
    except KeyError as error:
        raise GeometryError(f"{folder}: no COLMAP model that can be read (there is no camera {error})") from error
    except (OSError, ValueError, IndexError, OverflowError, struct.error) as error:
        raise GeometryError(f"{folder}: no COLMAP model that can be read ({error})") from error
    return sorted(images, key=lambda image: image.name)


def _cameras_bin(folder: Path) -> Iterator[tuple[int, str, int, int, list[float]]]:
    data = (folder / "cameras.bin").read_bytes()
    (count,) = struct.unpack_from("<Q", data, 0)
    at = 8
    for _ in range(count):
        number, model, width, height = struct.unpack_from("<IiQQ", data, at)
        name = _MODELS[model] if 0 <= model < len(_MODELS) else f"number {model}"
        focals, lens = _PERSPECTIVE.get(name, (0, -2))  # others are refused, however many parameters they have
        params = list(struct.unpack_from(f"<{focals + 2 + lens}d", data, at + 24))
        yield number, name, width, height, params
        at += 24 + 8 * len(params)


def _images_bin(folder: Path) -> Iterator[tuple[str, int, list[float]]]:
    data = (folder / "images.bin").read_bytes()
    (count,) = struct.unpack_from("<Q", data, 0)
    at = 8
    for _ in range(count):
        _, *pose, camera = struct.unpack_from("<I7dI", data, at)
        end = data.index(b"\0", at + 64)
        (points,) = struct.unpack_from("<Q", data, end + 1)
        yield data[at + 64 : end].decode(), camera, pose
        at = end + 9 + _POINT_BYTES * points
        if at > len(data):
            raise ValueError("images.bin ends within an image")


def _cameras_txt(folder: Path) -> Iterator[tuple[int, str, int, int, list[float]]]:
    for line in (folder / "cameras.txt").read_text(encoding="utf-8").splitlines():
        words = line.split()
        if words and not words[0].startswith("#"):
            number, model, width, height, *params = words
            yield int(number), model, int(width), int(height), [float(word) for word in params]


def _images_txt(folder: Path) -> Iterator[tuple[str, int, list[float]]]:
    """Of each image two lines, the second one its points."""
    lines = iter((folder / "images.txt").read_text(encoding="utf-8").splitlines())
    for line in lines:
        words = line.split()
        if words and not words[0].startswith("#"):
            if len(words) < 10:
                raise ValueError(f"images.txt: expected 10 words, got {line.strip()[:80]!r}")
            yield words[9], int(words[8]), [float(word) for word in words[1:8]]
            next(lines, None)


def _pose(values: list[float]) -> np.ndarray:
    """cam_from_world (4, 4) of a quaternion w x y z and a translation."""
    from scipy.spatial.transform import Rotation

    if not (np.abs(values) <= _LARGEST).all() or not any(values[:4]):
        raise ValueError(f"{values} is no pose")
    w, x, y, z = values[:4]
    return from_rotation(Rotation.from_quat([x, y, z, w]), values[4:])


def _camera(folder: Path, number: int, model: str, width: int, height: int, params: list[float]) -> Camera:
    focals, coefficients = _PERSPECTIVE.get(model, (0, 0))
    lens = params[focals + 2 :]
    if focals == 0 or any(lens[5:]):
        raise GeometryError(
            f"{folder}: camera {number} is of COLMAP's model {model}, of which this has no equal; run COLMAP's"
            " image_undistorter first, or map the images with the model OPENCV"
        )
    if len(params) != focals + 2 + coefficients:
        raise ValueError(f"camera {number} has {len(params)} parameters, {model} has {focals + 2 + coefficients}")
    k1, k2, p1, p2, k3 = (lens + [0.0] * 5)[:5]
    cx, cy = params[focals : focals + 2]
    return Camera(width, height, params[0], params[focals - 1], cx - _CENTRE, cy - _CENTRE, (k1, k2, p1, p2, k3))
