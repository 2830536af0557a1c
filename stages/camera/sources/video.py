"""A video file, through OpenCV; its frames come with the file's own times."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path

import cv2

from fieldpose.errors import SourceError
from fieldpose.stages.camera.calibration import Calibration, Calibrator
from fieldpose.stages.camera.config import CameraConfig
from fieldpose.stages.camera.core import CapturedFrame, Source
from fieldpose.stages.camera.sources.capture import opened
from fieldpose.stages.images import shrunk_with_camera

_FALLBACK_FPS = 30.0


def open_video(rest: str, config: CameraConfig, calibrator: Calibrator) -> Source:
    """video:FILE. Raises SourceError for a file that is missing, or from which no frame can be read."""
    path = Path(rest)
    with _capture(path) as capture:
        read, image = capture.read()
        if not read:
            raise SourceError(f"{path}: no frame of this video can be read; convert it, for instance to H.264 in .mp4")
        fps, length = capture.get(cv2.CAP_PROP_FPS), int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    calibration = calibrator.of(image.shape[1], image.shape[0])
    fps = fps if 0 < fps < 1000 else _FALLBACK_FPS

    def frames(first: int) -> Iterator[CapturedFrame]:
        return _frames(path, first, calibration, fps, config.size)

    return Source(f"video {path}, {fps:.4g} frames a second, {calibration.told}", "own", frames, max(length, 0) or None)


def _frames(path: Path, first: int, calibration: Calibration, fps: float, size: int | None) -> Iterator[CapturedFrame]:
    camera, origin = calibration.camera, calibration.origin
    at_ms, index = -1000 / fps, 0
    with _capture(path) as capture:
        while capture.grab():
            stated = capture.get(cv2.CAP_PROP_POS_MSEC)
            at_ms = stated if stated > at_ms else at_ms + 1000 / fps
            if index >= first:
                read, bgr = capture.retrieve()
                if not read or bgr.shape[:2] != (camera.height, camera.width):
                    raise SourceError(f"{path}: frame {index} cannot be read, or is not of the first one's size")
                image, resized = shrunk_with_camera(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), camera, size)
                name, at_ns = f"{path.name}#{index}", round(at_ms * 1e6)
                yield CapturedFrame(index, image, "rgb8", resized, name, at_ns, origin=origin)
            index += 1


def _capture(path: Path) -> AbstractContextManager[cv2.VideoCapture]:
    if not path.is_file():
        raise SourceError(f"{path}: no such video file")
    complaint = f"{path}: not a video that OpenCV can open; convert it, for instance to H.264 in .mp4"
    return opened(str(path), complaint, cv2.CAP_FFMPEG)
