"""Calibrations as other programs write them: ROS camera_info, OpenCV's FileStorage, Kalibr, COLMAP, transforms.json.

In a Camera, (0, 0) is the centre of the top-left pixel, as it is for ROS, OpenCV and Kalibr; COLMAP and transforms.json
have 0.5 there.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from fieldpose.errors import FieldposeError, SourceError
from fieldpose.stages.geometry import Camera

_LARGEST_BYTES, _LARGEST_YAML = 1 << 20, 1 << 16
_OPENCV_CAMERA = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "M1")
_OPENCV_LENS = ("distortion_coefficients", "distCoeffs", "dist_coeffs", "Distortion_Coefficients", "D", "D1")
_FISHEYE = {"equidistant", "fisheye", "kannala_brandt", "kb4", "opencv_fisheye", "simple_radial_fisheye"}
_PERSPECTIVE = {"plumb_bob", "rational_polynomial", "radtan", "none", "pinhole", ""}
_LENGTHS = (0, 4, 5, 8, 12, 14)
"""Coefficients that OpenCV's models have."""
_COLMAP = {
    "SIMPLE_PINHOLE": (1, ()),
    "PINHOLE": (2, ()),
    "SIMPLE_RADIAL": (1, ("k1",)),
    "RADIAL": (1, ("k1", "k2")),
    "OPENCV": (2, ("k1", "k2", "p1", "p2")),
    "FULL_OPENCV": (2, ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
}
"""Focal lengths and coefficients of COLMAP's models, in the order of its parameters; the principal point is between."""
_EXPECTED = (
    "expected JSON with width, height, fx, fy, cx, cy in pixels and maybe distortion [k1, k2, p1, p2, k3], ROS'"
    " camera_info or OpenCV's or Kalibr's YAML, OpenCV's XML, or COLMAP's cameras.txt"
)


class _Yaml(yaml.SafeLoader):
    """Takes OpenCV's matrices for the mappings that they are, and no aliases, by which a few lines become gigabytes."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            raise ValueError("it refers to other parts of itself (*); write the values out")
        return super().compose_node(parent, index)


_Yaml.add_constructor(
    "tag:yaml.org,2002:opencv-matrix",
    lambda loader, node: loader.construct_mapping(node, deep=True),  # type: ignore[arg-type]
)


@dataclass(frozen=True)
class _Numbers:
    """Of a file: size, intrinsics by a first pixel whose centre is at `centre`, coefficients in OpenCV's order."""

    size: Sequence[Any]
    focal: Sequence[Any]
    principal: Sequence[Any]
    coefficients: Sequence[Any] = ()
    model: str = ""
    centre: float = 0.0


def read_camera_file(path: Path) -> Camera:
    """Read a calibration of any kind that is known. Raises SourceError, which says what it lacks."""
    try:
        content = path.read_bytes()[: _LARGEST_BYTES + 1]
    except FileNotFoundError:
        raise SourceError(f"{path}: no such camera file") from None
    except OSError as error:
        raise SourceError(f"{path}: cannot be read: {error.strerror}") from error
    try:
        return _camera(_numbers(path, content))
    except (
        FieldposeError, LookupError, TypeError, ValueError, ArithmeticError, AttributeError, RecursionError,
        yaml.YAMLError, cv2.error,
    ) as error:  # fmt: skip
        why = f"{error.args[0]} is missing" if isinstance(error, KeyError) else " ".join(str(error).split())
        raise SourceError(f"{path}: no usable camera file ({why}); {_EXPECTED}") from error


def camera_of(
    size: Sequence[int], focal: Sequence[float], principal: Sequence[float], coefficients: Sequence[float], model: str
) -> Camera:
    """A camera of width and height, intrinsics in pixels and coefficients in OpenCV's order; model: as ROS names it.

    Raises GeometryError or ValueError for what makes no camera, and for lenses that are not supported, by their name.
    """
    return _camera(_Numbers(size, focal, principal, coefficients, model))


def _numbers(path: Path, content: bytes) -> _Numbers:
    if len(content) > _LARGEST_BYTES:
        raise ValueError(f"it has more than {_LARGEST_BYTES} bytes")
    text = content.decode("utf-8-sig")
    if text.lstrip().startswith("<?xml"):
        return _opencv_xml(path)
    if text.lstrip().startswith("{"):
        return _json(json.loads(text))
    if path.suffix == ".txt":
        return _colmap(text)
    if len(content) > _LARGEST_YAML:
        raise ValueError(f"as YAML it has more than {_LARGEST_YAML} bytes")
    # OpenCV writes a directive that YAML has otherwise.
    document = yaml.load("\n".join(line for line in text.splitlines() if not line.startswith("%YAML")), _Yaml)
    if not isinstance(document, dict):
        raise TypeError("neither JSON, XML nor YAML with keys")
    if any(
        str(key).startswith("cam") and isinstance(value, dict) and "intrinsics" in value
        for key, value in document.items()
    ):
        return _kalibr(document)
    return _ros_or_opencv(document)


def _camera(numbers: _Numbers) -> Camera:
    model = numbers.model.lower()
    if model in _FISHEYE:
        raise ValueError(f"{numbers.model} is a fisheye lens, which is not supported; undistort the images first")
    if model not in _PERSPECTIVE:
        raise ValueError(f"distortion model {numbers.model!r} is not known")
    lens = [float(value) for value in numbers.coefficients]
    if len(lens) not in _LENGTHS:
        raise ValueError(f"{len(lens)} distortion coefficients; expected one of {', '.join(map(str, _LENGTHS))}")
    beyond = {f"k{4 + i}" if i < 3 else f"coefficient {6 + i}": v for i, v in enumerate(lens[5:]) if v != 0}
    if beyond:
        raise ValueError(
            f"{', '.join(beyond)} of OpenCV's rational model are not supported; calibrate with five at most"
        )
    k1, k2, p1, p2, k3 = (lens + [0.0] * 5)[:5]
    (fx, fy), (cx, cy) = ((float(v) for v in pair) for pair in (numbers.focal, numbers.principal))
    width, height = (_whole(v) for v in numbers.size)
    return Camera(width, height, fx, fy, cx - numbers.centre, cy - numbers.centre, (k1, k2, p1, p2, k3))


def _whole(value: Any) -> int:
    if float(value) != int(value):
        raise ValueError(f"a size of {value} pixels is no whole number")
    return int(value)


def _json(content: Mapping[str, Any]) -> _Numbers:
    if "fl_x" in content:
        lens = [content.get(name) or 0.0 for name in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")]
        model = str(content.get("camera_model", ""))
        perspective = model.upper() in {*_COLMAP, "PERSPECTIVE", ""}
        fisheye = content.get("is_fisheye") or not perspective
        return _Numbers(
            (content["w"], content["h"]), (content["fl_x"], content.get("fl_y", content["fl_x"])),
            (content["cx"], content["cy"]), lens, "fisheye" if fisheye else "", 0.5,
        )  # fmt: skip
    known = {"width", "height", "fx", "fy", "cx", "cy", "distortion"}
    unknown = sorted(content.keys() - known)
    if unknown:
        raise ValueError(f"key {unknown[0]!r} is not known")
    return _Numbers(
        (content["width"], content["height"]), (content["fx"], content["fy"]), (content["cx"], content["cy"]),
        content.get("distortion", ()),
    )  # fmt: skip


def _ros_or_opencv(content: Mapping[str, Any]) -> _Numbers:
    matrix, lens = _first(content, _OPENCV_CAMERA), _first(content, _OPENCV_LENS)
    if matrix is None:
        raise KeyError("camera_matrix")
    size = content["image_size"] if "image_size" in content else (content["image_width"], content["image_height"])
    size = size.get("data", ()) if isinstance(size, dict) else size
    model = "fisheye" if content.get("fisheye_model") else str(content.get("distortion_model", ""))
    return _of_matrix(size, _data(matrix), () if lens is None else _data(lens), model)


def _of_matrix(size: Sequence[Any], matrix: Sequence[Any], lens: Sequence[Any], model: str) -> _Numbers:
    fx, skew, cx, _, fy, cy = (float(value) for value in matrix[:6])
    if skew != 0:
        raise ValueError(f"a skew of {skew:g} px between the axes is not supported")
    return _Numbers(size, (fx, fy), (cx, cy), lens, model)


def _first(content: Mapping[str, Any], names: Sequence[str]) -> Any:
    return next((content[name] for name in names if name in content), None)


def _data(value: Any) -> list[Any]:
    return list(np.ravel(value["data"] if isinstance(value, dict) else value))


def _kalibr(content: Mapping[str, Any]) -> _Numbers:
    cameras = [value for key, value in sorted(content.items()) if str(key).startswith("cam")]
    if len(cameras) > 1:
        raise ValueError(f"it has {len(cameras)} cameras; leave the one that is meant")
    camera = cameras[0]
    if camera.get("camera_model", "pinhole") != "pinhole":
        raise ValueError(f"camera_model {camera['camera_model']} is not supported; calibrate a pinhole camera")
    fx, fy, cx, cy = camera["intrinsics"]
    coefficients, model = camera.get("distortion_coeffs", ()), str(camera.get("distortion_model", ""))
    return _Numbers(camera["resolution"], (fx, fy), (cx, cy), coefficients, model)


def _colmap(text: str) -> _Numbers:
    lines = [line.split() for line in text.splitlines() if line.strip() and not line.startswith("#")]
    if len(lines) != 1:
        raise ValueError(f"it has {len(lines)} cameras; leave the one that is meant")
    if len(lines[0]) < 5:
        raise ValueError("a camera is its number, model, width, height and parameters")
    _, model, width, height, *rest = lines[0]
    if model not in _COLMAP:
        raise ValueError(f"COLMAP's model {model} is not supported; undistort the images to PINHOLE first")
    focals, names = _COLMAP[model]
    params = [float(value) for value in rest]
    if len(params) != focals + 2 + len(names):
        raise ValueError(f"{model} has {focals + 2 + len(names)} parameters, got {len(params)}")
    focal = params[:focals] * (3 - focals)
    lens = (params[focals + 2 :] + [0.0] * 4)[: max(len(names), 4)]
    return _Numbers((int(width), int(height)), focal, params[focals : focals + 2], lens, centre=0.5)


def _opencv_xml(path: Path) -> _Numbers:
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    except SystemError as error:
        raise ValueError("no XML that OpenCV can read") from error
    try:
        matrix = next((m for n in _OPENCV_CAMERA if (m := storage.getNode(n).mat()) is not None), None)
        lens = next((m for n in _OPENCV_LENS if (m := storage.getNode(n).mat()) is not None), None)
        size = [storage.getNode(name) for name in ("image_width", "image_height")]
        if matrix is None:
            raise KeyError("camera_matrix")
        if any(node.empty() for node in size):
            raise KeyError("image_width or image_height")
        fisheye = storage.getNode("fisheye_model")
        model = "fisheye" if not fisheye.empty() and fisheye.real() else ""
        return _of_matrix([node.real() for node in size], _data(matrix), () if lens is None else _data(lens), model)
    finally:
        storage.release()
