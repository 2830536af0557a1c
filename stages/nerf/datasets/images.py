"""Reading single image files: size without decoding, pixels, depths and masks, always at the size asked for."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from PIL import Image, ImageOps

from fieldpose.errors import DatasetError
from fieldpose.stages.geometry.cameras import LARGEST_SIDE
from fieldpose.stages.images import MOST_PIXELS

EXTENSIONS = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
ORIENTATION = 0x0112
"""EXIF's number for it; from 5 on width and height change places."""
_FIRST_ACROSS = 5
_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "DIB", "TIFF", "PPM", "GIF")
"""What Pillow may try: among its others are some that start programs."""
_SIXTEEN_BITS = ("I", "I;16", "I;16B", "I;16L", "I;16N")
Colour = tuple[int, int, int]
WHITE: Colour = (255, 255, 255)
PLAIN_WITHIN, PLAIN_SHARE, PLAIN_BORDER = 6, 0.95, 0.02
"""How far levels of a plain background may be from its colour (JPEG's noise), in which share of the pixels along an
image's border, which is so wide, as a share of the image. The object may reach into a twentieth of it."""
_BAND = 256
_Result = TypeVar("_Result")


@dataclass(frozen=True)
class ImageHeader:
    """What a file says of its image before any pixel is decoded."""

    width: int
    height: int
    has_alpha: bool


def is_image_name(path: Path) -> bool:
    """Whether a file is one of a folder's images by its name; hidden ones are not, as zips made on a Mac have them."""
    return path.suffix.lower() in EXTENSIONS and not path.name.startswith(".")


def probe(path: Path) -> ImageHeader:
    """Read the header of an image file. DatasetError if it is missing or no image."""
    return _read(path, lambda image: ImageHeader(image.width, image.height, _has_alpha(image)))


def load_pixels(path: Path, width: int, height: int, alpha: bool) -> np.ndarray:
    """The image as (height, width, 4 if alpha else 3) uint8 RGB(A), resized by area.

    EXIF orientation is ignored, as it is by the programs that solve for the poses. DatasetError if the file is
    missing, truncated or no image.
    """
    pixels = _read(path, lambda image: _colours(image, alpha))
    return resized_rgba(pixels, width, height) if alpha else _resize(pixels, width, height)


def load_depth(path: Path, width: int, height: int, scale: float) -> np.ndarray:
    """Depth along the optical axis, (height, width) float32: the stored numbers times scale, 0 where unknown.

    Reads one-channel images (8, 16 or 32 bit) and .npy files; depths of neighbouring pixels are never mixed.
    """
    stored = load_array(path) if path.suffix == ".npy" else _read(path, np.array)
    if stored.ndim != 2 or stored.dtype.kind not in "biuf":
        raise DatasetError(f"{path}: expected one depth a pixel, got shape {stored.shape} of {stored.dtype}")
    return _resize_nearest(stored.astype(np.float32) * np.float32(scale), width, height)


def load_mask(path: Path, width: int, height: int) -> np.ndarray:
    """A mask image as (height, width) bool: True where it is brighter than half of its brightest, be that 255 or 1."""
    grey = _read(path, lambda image: np.array(image.convert("L")))
    return _resize_nearest(grey, width, height) > int(grey.max()) / 2


def plain_background(load: Sequence[Callable[[], np.ndarray]]) -> Colour | None:
    """The one colour that surrounds what all images, (h, w, 3) uint8, show; None if there is none.

    Later images are not loaded once one has another border.
    """
    colour, shows_something = None, False
    for image in load:
        pixels = image()
        border = _border(pixels).astype(np.int16)
        if colour is None:
            colour = np.median(border, axis=0)
        if (np.abs(border - colour).max(axis=1) <= PLAIN_WITHIN).mean() < PLAIN_SHARE:
            return None
        shows_something = shows_something or any(
            (np.abs(pixels[rows] - colour) > PLAIN_WITHIN).any() for rows in _bands(len(pixels))
        )
    if colour is None or not shows_something:
        return None
    red, green, blue = (int(v) for v in np.rint(colour))
    return red, green, blue


def _border(image: np.ndarray) -> np.ndarray:
    """Pixels (n, 3) along the border of an image (h, w, 3)."""
    wide = max(1, round(PLAIN_BORDER * min(image.shape[:2])))
    inner = np.zeros(image.shape[:2], bool)
    inner[wide:-wide, wide:-wide] = True
    return image[~inner]


def over_background(rgba: np.ndarray, background: Colour | None) -> np.ndarray:
    """Lay (h, w, 4) uint8 over a colour (None: black); (h, w, 3) comes back as it is."""
    if rgba.shape[-1] == 3:
        return rgba
    result = np.empty((*rgba.shape[:2], 3), np.uint8)
    for rows in _bands(len(rgba)):
        alpha = rgba[rows, :, 3:].astype(np.float32) / 255
        colour = rgba[rows, :, :3] * alpha + np.array(background or (0, 0, 0), np.float32) * (1 - alpha)
        result[rows] = np.rint(colour).astype(np.uint8)
    return result


def _bands(height: int) -> list[slice]:
    """Rows of an image, so many at once that numbers larger than its bytes take little memory."""
    return [slice(first, first + _BAND) for first in range(0, height, _BAND)]


def upright(path: Path) -> np.ndarray:
    """The pixels (h, w, 3) uint8 RGB of an image file, turned as its EXIF orientation says.

    Transparent parts are laid over white. Raises DatasetError.
    """

    def turned(image: Image.Image) -> np.ndarray:
        return over_background(_colours(ImageOps.exif_transpose(image), _has_alpha(image)), WHITE)

    return _read(path, turned)


def upright_rgba(path: Path) -> np.ndarray:
    """The pixels (h, w, 4) uint8 of an image file, turned as its EXIF orientation says. Raises DatasetError."""
    return _read(path, lambda image: _colours(ImageOps.exif_transpose(image), alpha=True))


def is_opaque(path: Path) -> bool:
    """Whether an image file has no alpha channel, or one that is opaque everywhere. Raises DatasetError."""
    return _read(path, lambda image: not _has_alpha(image) or bool((_colours(image, alpha=True)[..., 3] == 255).all()))


def orientation(path: Path) -> int:
    """The EXIF orientation of an image file, 1 to 8; 1: as it is stored, and where it says nothing. DatasetError."""
    stated = _read(path, lambda image: image.getexif().get(ORIENTATION, 1))
    return int(stated) if stated in range(1, 9) else 1


def upright_size(path: Path) -> tuple[int, int]:
    """Width and height of an image file as upright() gives it. Raises DatasetError."""

    def size(image: Image.Image) -> tuple[int, int]:
        across = image.getexif().get(ORIENTATION, 1) >= _FIRST_ACROSS
        return (image.height, image.width) if across else (image.width, image.height)

    return _read(path, size)


def is_plain_jpeg(path: Path) -> bool:
    """Whether an image file is a JPEG of three colours that its EXIF does not turn. Raises DatasetError."""
    return _read(path, lambda image: image.format == "JPEG" and image.mode == "RGB") and orientation(path) == 1


def _read(path: Path, use: Callable[[Image.Image], _Result]) -> _Result:
    try:
        with Image.open(path, formats=_FORMATS) as image:
            if max(image.size) > LARGEST_SIDE or image.width * image.height > MOST_PIXELS:
                size = f"{image.width}x{image.height} pixels where {LARGEST_SIDE} a side and {MOST_PIXELS}"
                raise ValueError(f"{size} are the most")
            return use(image)
    except FileNotFoundError as error:
        raise DatasetError(f"{path}: no such image; restore the file, or name another") from error
    except Exception as error:  # Pillow does not tell what its decoders raise
        reason = "not an image" if isinstance(error, Image.UnidentifiedImageError) else error
        raise DatasetError(f"{path}: cannot be read ({reason}); restore the file, or leave it out") from error


def _colours(image: Image.Image, alpha: bool) -> np.ndarray:
    """(h, w, 4 if alpha else 3) uint8; grey values of 16 bits are scaled, which PIL would cut off."""
    if image.mode in _SIXTEEN_BITS:
        levels = np.clip(np.asarray(image).astype(np.float32), 0, 65535) / 257
        image = Image.fromarray(np.rint(levels).astype(np.uint8))
    wanted = "RGBA" if alpha else "RGB"
    return np.array(image if image.mode == wanted else image.convert(wanted))


def load_array(path: Path) -> np.ndarray:
    """The numbers of a .npy file, whose shape is believed where the file has as many bytes. Raises DatasetError."""
    try:
        with path.open("rb") as file:
            version = np.lib.format.read_magic(file)
            read_header = (
                np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            )
            shape, _, dtype = read_header(file)
            there, stated = path.stat().st_size - file.tell(), math.prod(shape) * dtype.itemsize
            if dtype.kind not in "biufc" or min(shape, default=0) < 0 or stated != there:
                raise ValueError(f"{there} bytes where {dtype} of shape {shape} is stated")
        return np.load(path, allow_pickle=False)
    except Exception as error:  # numpy reads the header as Python, and raises what its parser does
        raise DatasetError(f"{path}: not a readable .npy file ({error}); export it again") from error


def _has_alpha(image: Image.Image) -> bool:
    return image.mode in ("RGBA", "LA", "PA", "RGBa", "La") or "transparency" in image.info


def _resize(pixels: np.ndarray, width: int, height: int) -> np.ndarray:
    if pixels.shape[:2] == (height, width):
        return pixels
    shrinks = width <= pixels.shape[1] and height <= pixels.shape[0]
    return cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)


def resized_rgba(pixels: np.ndarray, width: int, height: int) -> np.ndarray:
    """(height, width, 4) uint8: colours are averaged weighted by alpha, so that none from behind bleed into edges."""
    if pixels.shape[:2] == (height, width):
        return pixels
    # A channel at a time: as floats all of a large image's take four times its memory.
    weight = pixels[..., 3].astype(np.float32)
    alpha = _resize(weight, width, height)
    weight /= 255
    result = np.empty((height, width, 4), np.uint8)
    result[..., 3] = np.rint(np.clip(alpha, 0, 255))
    for channel in range(3):
        resized = _resize(pixels[..., channel] * weight, width, height)
        colour = np.divide(resized * 255, alpha, out=np.zeros_like(resized), where=alpha > 0)
        result[..., channel] = np.rint(np.clip(colour, 0, 255))
    return result


def _resize_nearest(values: np.ndarray, width: int, height: int) -> np.ndarray:
    if values.shape == (height, width):
        return values
    return cv2.resize(values, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)


def load_photo(path: Path) -> np.ndarray:
    """The pixels (h, w, 3) uint8 RGB of an image file as they are stored, transparent parts laid over white.

    Raises DatasetError.
    """
    header = probe(path)
    return over_background(load_pixels(path, header.width, header.height, header.has_alpha), WHITE)
