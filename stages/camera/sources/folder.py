"""A folder of images, in natural order of their names."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from fieldpose.errors import DatasetError, SourceError
from fieldpose.stages.camera.calibration import Calibration, Calibrator
from fieldpose.stages.camera.config import CameraConfig
from fieldpose.stages.camera.core import CapturedFrame, Source
from fieldpose.stages.images import shrunk_with_camera
from fieldpose.stages.nerf.datasets.images import EXTENSIONS, is_image_name, is_plain_jpeg, probe


def open_folder(rest: str, config: CameraConfig, calibrator: Calibrator) -> Source:
    """folder:DIR. Raises SourceError for a missing or empty folder, and for a file that is no image."""
    root = Path(rest)
    if not root.is_dir():
        raise SourceError(f"{root}: no such folder of images")
    paths = sorted((path for path in root.iterdir() if is_image_name(path)), key=natural)
    if not paths:
        raise SourceError(f"{root}: no images in this folder; expected {', '.join(EXTENSIONS)}")
    told = _read(0, paths[0], config, calibrator)[1].told

    def frames(first: int) -> Iterator[CapturedFrame]:
        for i, path in enumerate(paths[first:], first):
            yield _read(i, path, config, calibrator)[0]

    return Source(f"{len(paths)} images of {root}, {told}", "none", frames, len(paths))


def natural(path: Path) -> list[tuple[int, str]]:
    """Sort key by which frame2 comes before frame10."""
    parts = re.split(r"(\d+)", path.name.lower())
    return [(int(part), "") if part.isdecimal() else (0, part) for part in parts]


def _read(frame_id: int, path: Path, config: CameraConfig, calibrator: Calibrator) -> tuple[CapturedFrame, Calibration]:
    try:
        if _can_stay_encoded(path, config.size):
            header = probe(path)
            calibration = calibrator.of(header.width, header.height, path)
            encoded = np.frombuffer(path.read_bytes(), np.uint8)
            frame = CapturedFrame(frame_id, encoded, "jpeg", calibration.camera, path.name, origin=calibration.origin)
            return frame, calibration
        pixels, calibration = calibrator.photo(path)
    except (DatasetError, OSError) as error:
        raise SourceError(str(error)) from error
    image, camera = shrunk_with_camera(pixels, calibration.camera, config.size)
    return CapturedFrame(frame_id, image, "rgb8", camera, path.name, origin=calibration.origin), calibration


def _can_stay_encoded(path: Path, size: int | None) -> bool:
    """An RGB JPEG, small enough, that no decoder turns."""
    header = probe(path)
    return is_plain_jpeg(path) and (size is None or max(header.width, header.height) <= size)
