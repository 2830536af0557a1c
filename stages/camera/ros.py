"""ROS' messages of cameras: the pixels of Image and CompressedImage, the camera of CameraInfo, and stamps.

The messages are objects with ROS' field names, of whatever library has read them; those of ROS 1 have K, D and P where
those of ROS 2 have k, d and p.
"""

from __future__ import annotations

import re
from typing import Any

import cv2
import numpy as np

from fieldpose.bus.messages import Encoding
from fieldpose.errors import SourceError
from fieldpose.stages.camera.camera_files import camera_of
from fieldpose.stages.geometry import Camera
from fieldpose.stages.images import MOST_PIXELS, encoded_size

IMAGE, COMPRESSED, INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo"
"""Types by the names that ROS 2 has for them."""
_RECTIFIED = "image_rect"
_COLOURS: dict[str, tuple[type[np.generic], int, int | None]] = {
    "rgb8": (np.uint8, 3, None),
    "bgr8": (np.uint8, 3, cv2.COLOR_BGR2RGB),
    "rgba8": (np.uint8, 4, cv2.COLOR_RGBA2RGB),
    "bgra8": (np.uint8, 4, cv2.COLOR_BGRA2RGB),
    "mono8": (np.uint8, 1, cv2.COLOR_GRAY2RGB),
    "mono16": (np.uint16, 1, cv2.COLOR_GRAY2RGB),
    "yuv422": (np.uint8, 2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": (np.uint8, 2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (np.uint8, 2, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": (np.uint8, 2, cv2.COLOR_YUV2RGB_YUY2),
}
# What OpenCV has for arrays; of 8 bits they may well be pictures.
_NUMBERS = re.compile(r"(16U|16S|32S|32F|64F)C\d*")
# ROS names a pattern by its first two rows, as OpenCV's newer names do.
_PATTERNS = {
    "rggb": cv2.COLOR_BayerRGGB2RGB,
    "bggr": cv2.COLOR_BayerBGGR2RGB,
    "gbrg": cv2.COLOR_BayerGBRG2RGB,
    "grbg": cv2.COLOR_BayerGRBG2RGB,
}
for _pattern, _code in _PATTERNS.items():
    _COLOURS[f"bayer_{_pattern}8"] = (np.uint8, 1, _code)
    _COLOURS[f"bayer_{_pattern}16"] = (np.uint16, 1, _code)


def image_of(message: Any) -> tuple[np.ndarray, Encoding]:
    """Of an Image the pixels (h, w, 3) uint8 RGB, of a CompressedImage the jpeg or png file (n,) uint8.

    Of 16 bits the upper 8 are taken, and a file of a colour filter's pattern is unfolded. Raises SourceError for
    encodings that are not supported, by their name, and for data that is not what it says.
    """
    return (_pixels(message), "rgb8") if hasattr(message, "encoding") else _compressed(message)


def size_of(pixels: np.ndarray, encoding: Encoding) -> tuple[int, int] | None:
    """Width and height of what image_of gives; None for a file that cannot be read."""
    return encoded_size(pixels) if encoding != "rgb8" else (pixels.shape[1], pixels.shape[0])


def camera_of_info(message: Any, rectified: bool) -> Camera | None:
    """The camera of a CameraInfo's images; None where it says that nothing is known (K, or P, is 0).

    Raw images are described by K and D, rectified ones by P, without distortion. A region of interest is cut out and
    binning averages pixels, so that a pixel's centre moves, which ROS' own image_geometry leaves out.
    Raises SourceError for lenses that are not supported. Source: REP 104.
    """
    matrix = _field(message, "p" if rectified else "k")
    fx, fy = float(matrix[0]), float(matrix[5 if rectified else 4])
    cx, cy = float(matrix[2]), float(matrix[6 if rectified else 5])
    if fx == 0:
        return None
    if matrix[1] != 0:
        raise SourceError(f"its CameraInfo has a skew of {matrix[1]:g} px between the axes, which is not supported")
    lens, model = ([], "") if rectified else ([float(v) for v in _field(message, "d")], str(message.distortion_model))
    region, size = message.roi, (int(message.width), int(message.height))
    if region.width and region.height:
        size, cx, cy = (int(region.width), int(region.height)), cx - region.x_offset, cy - region.y_offset
    bins = max(int(message.binning_x), 1), max(int(message.binning_y), 1)
    width, height = (n // b for n, b in zip(size, bins, strict=True))
    try:
        camera = camera_of((width * bins[0], height * bins[1]), (fx, fy), (cx, cy), lens, model)
        return camera if bins == (1, 1) else camera.resized(width, height)
    except ValueError as error:
        raise SourceError(f"its CameraInfo cannot be used: {error}") from error


def info_topic(image_topic: str) -> str:
    """The topic of the CameraInfo of an image topic: camera_info beside it, and beside what was compressed."""
    base = image_topic.removesuffix("/compressed")
    return f"{base.rpartition('/')[0]}/camera_info"


def is_rectified(image_topic: str) -> bool:
    """Whether an image topic is, by ROS' names, one of rectified images."""
    return image_topic.removesuffix("/compressed").rpartition("/")[2].startswith(_RECTIFIED)


def stamp_ns(message: Any) -> int:
    """A message's own time in nanoseconds, 0 where it has none, as before the epoch."""
    stamp = message.header.stamp
    return max(int(stamp.sec) * 10**9 + int(stamp.nanosec), 0)


def _field(message: Any, name: str) -> Any:
    return getattr(message, name) if hasattr(message, name) else getattr(message, name.upper())


def _pixels(message: Any) -> np.ndarray:
    known = _COLOURS.get(message.encoding)
    if known is None:
        raise SourceError(
            f"encoding {message.encoding!r} is not supported; expected {', '.join(sorted(_COLOURS))}, or an image"
            " compressed as jpeg or png"
        )
    kind, channels, code = known
    height, width, step = int(message.height), int(message.width), int(message.step)
    row = width * channels * np.dtype(kind).itemsize
    data = np.frombuffer(bytes(message.data), np.uint8)
    if min(width, height) < 1 or step < row or len(data) < height * step:
        raise SourceError(
            f"an image of {width}x{height} as {message.encoding} has {len(data)} bytes in rows of {step}; expected at"
            f" least {height} rows of {row}"
        )
    rows = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, :row])
    if kind is np.uint16:
        rows = rows.view(">u2" if message.is_bigendian else "<u2")
    return _converted(rows.reshape(height, width, channels), code)


def _compressed(message: Any) -> tuple[np.ndarray, Encoding]:
    file = np.frombuffer(bytes(message.data), np.uint8)
    head = file[:4].tobytes()
    encoding: Encoding | None = "jpeg" if head[:3] == b"\xff\xd8\xff" else "png" if head == b"\x89PNG" else None
    if encoding is None:
        raise SourceError(f"a compressed image of format {message.format!r} is neither jpeg nor png; convert it")
    # "bayer_rggb8; jpeg compressed bgr8" was unfolded before it was compressed, with nothing at the end it was not.
    original, _, target = str(message.format).partition(";")
    if _NUMBERS.fullmatch(original.strip()):
        raise SourceError(f"a compressed image of format {message.format!r} holds numbers, as of depth, and no picture")
    known = _COLOURS.get(original.strip()) if original.startswith("bayer_") else None
    if known is None or target.split()[-1:] in (["bgr8"], ["rgb8"], ["mono8"]):
        return file, encoding
    size = encoded_size(file)
    fits = size is not None and size[0] * size[1] <= MOST_PIXELS
    mosaic = cv2.imdecode(file, cv2.IMREAD_ANYDEPTH | cv2.IMREAD_GRAYSCALE) if fits else None
    if mosaic is None:
        raise SourceError(f"a compressed image of format {message.format!r} cannot be read")
    return _converted(mosaic, known[2]), "rgb8"


def _converted(image: np.ndarray, code: int | None) -> np.ndarray:
    pixels = (image >> 8).astype(np.uint8) if image.dtype.itemsize == 2 else image
    try:
        return pixels if code is None else np.asarray(cv2.cvtColor(pixels, code))
    except cv2.error as error:  # pixels of an odd number whose colours are told in pairs
        height, width = image.shape[:2]
        raise SourceError(f"an image of {width}x{height} pixels cannot be of its encoding ({error.err})") from error
