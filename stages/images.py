"""Images in memory: shrinking them, alone or with their camera, and decoding them."""

from __future__ import annotations

import io
import warnings

import cv2
import numpy as np
from PIL import Image

from fieldpose.errors import GeometryError
from fieldpose.stages.geometry import Camera, shrunk_size

MOST_PIXELS = 120_000_000
"""Of an image file; reading one takes at most 17 bytes a pixel, 2 GB."""
# What Pillow says of large or damaged images is said by errors, or is no matter.
warnings.filterwarnings("ignore", module=r"PIL\.")
warnings.filterwarnings("ignore", category=Image.DecompressionBombWarning)


def shrunk(image: np.ndarray, longer_side: int) -> np.ndarray:
    """An image (h, w) or (h, w, k), averaged over areas so that its longer side is at most `longer_side`.

    The image itself where it is no larger.
    """
    height, width = image.shape[:2]
    size = shrunk_size(width, height, longer_side)
    return image if size == (width, height) else cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def shrunk_with_camera(image: np.ndarray, camera: Camera, longer_side: int | None) -> tuple[np.ndarray, Camera]:
    """As `shrunk`, and the camera of the result; None leaves both as they are."""
    if longer_side is None:
        return image, camera
    return shrunk(image, longer_side), camera.shrunk(longer_side)


def decoded(encoding: str, image: np.ndarray, width: int, height: int) -> np.ndarray | None:
    """An image (height, width, 3) uint8 RGB: `rgb8` as it is, else from the bytes (n,) uint8 of a jpeg or png file.

    EXIF orientation is ignored. None where the bytes are no image of that size, which is seen by their head: another
    size takes no memory.
    """
    if encoding == "rgb8":
        return image
    if encoded_size(image) != (width, height):
        return None
    try:
        bgr = cv2.imdecode(image, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        return None
    if bgr is None or bgr.shape[:2] != (height, width):
        return None
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)


def encoded_size(image: np.ndarray) -> tuple[int, int] | None:
    """Width and height by the head of a jpeg or png file's bytes (n,) uint8; None where they are none."""
    try:
        with Image.open(io.BytesIO(image.tobytes()), formats=("JPEG", "PNG")) as opened:
            return opened.size
    except Exception:  # Pillow does not tell what its decoders raise
        return None


def checked_image(image: np.ndarray) -> None:
    """Raise GeometryError unless this is an image (h, w, 3) uint8."""
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or 0 in image.shape:
        raise GeometryError(f"expected an image (h, w, 3) uint8 RGB, got {image.dtype} {image.shape}")
