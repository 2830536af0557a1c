"""OpenCV's VideoCapture for files and devices: opened, or refused with one clear error, and always released."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import cv2

from fieldpose.errors import SourceError

_FFMPEG_QUIET = "-8"


@contextmanager
def opened(source: str | int, complaint: str, backend: int = cv2.CAP_ANY) -> Iterator[cv2.VideoCapture]:
    """The capture of a file or device; SourceError(complaint) if it cannot be opened.

    OpenCV and FFmpeg would print several lines about that, so they are kept quiet meanwhile.
    """
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", _FFMPEG_QUIET)
    before = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        capture = cv2.VideoCapture(source, backend)
    finally:
        cv2.utils.logging.setLogLevel(before)
    try:
        if not capture.isOpened():
            raise SourceError(complaint)
        yield capture
    finally:
        capture.release()
