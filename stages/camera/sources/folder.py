"""A folder of images, in natural order of their names."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image

from fieldpose.errors import DatasetError, SourceError
from fieldpose.stages.camera.calibration import Calibrator
from fieldpose.stages.camera.config import CameraConfig
from fieldpose.stages.camera.core import CapturedFrame, Source
from fieldpose.stages.images import shrunk_with_camera
from fieldpose.stages.nerf.datasets.images import (
    EXTENSIONS,
    ORIENTATION,
    WHITE,
    is_image_name,
    load_pixels,
    over_background,
    probe,
)


def open_folder(rest: str, config: CameraConfig, calibrator: Calibrator) -> Source:
    """folder:DIR. Raises SourceError for a missing or empty folder, and for a file that is no image."""
    root = Path(rest)
    if not root.is_dir():
        raise SourceError(f"{root}: no such folder of images")
    paths = sorted((path for path in root.iterdir() if is_image_name(path)), key=natural)
    if not paths:
        raise SourceError(f"{root}: no images in this folder; expected {', '.join(EXTENSIONS)}")
    told = calibrator.of(*_size(paths[0]), paths[0]).told

    def frames(first: int) -> Iterator[CapturedFrame]:
        for i, path in enumerate(paths[first:], first):
            yield _read(i, path, config, calibrator)

    return Source(f"{len(paths)} images of {root}, {told}", "none", frames, len(paths))


def natural(path: Path) -> list[tuple[int, str]]:
    """Sort key by which frame2 comes before frame10."""
    parts = re.split(r"(\d+)", path.name.lower())
    return [(int(part), "") if part.isdecimal() else (0, part) for part in parts]


def _read(frame_id: int, path: Path, config: CameraConfig, calibrator: Calibrator) -> CapturedFrame:
    width, height = _size(path)
    calibration = calibrator.of(width, height, path)
    camera, origin = calibration.camera, calibration.origin
    if _can_stay_encoded(path) and (config.size is None or max(width, height) <= config.size):
        encoded = np.frombuffer(path.read_bytes(), np.uint8)
        return CapturedFrame(frame_id, encoded, "jpeg", camera, path.name, origin=origin)
    try:
        pixels = over_background(load_pixels(path, width, height, probe(path).has_alpha), WHITE)
    except DatasetError as error:
        raise SourceError(str(error)) from error
    image, camera = shrunk_with_camera(pixels, camera, config.size)
    return CapturedFrame(frame_id, image, "rgb8", camera, path.name, origin=origin)


def _size(path: Path) -> tuple[int, int]:
    try:
        header = probe(path)
    except DatasetError as error:
        raise SourceError(str(error)) from error
    return header.width, header.height


def _can_stay_encoded(path: Path) -> bool:
    """An RGB JPEG that no decoder turns: EXIF orientation is ignored here, as it is in datasets."""
    with Image.open(path) as image:
        return image.format == "JPEG" and image.mode == "RGB" and image.getexif().get(ORIENTATION, 1) == 1
