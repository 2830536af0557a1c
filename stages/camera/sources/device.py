"""A camera that is plugged in, through OpenCV; a frame's time is when it was taken."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import cv2

from fieldpose.errors import SourceError
from fieldpose.stages.camera.calibration import Calibration, Calibrator
from fieldpose.stages.camera.config import CameraConfig
from fieldpose.stages.camera.core import CapturedFrame, Source
from fieldpose.stages.camera.sources.capture import opened
from fieldpose.stages.images import shrunk_with_camera


def open_device(rest: str, config: CameraConfig, calibrator: Calibrator) -> Source:
    """camera:NUMBER or camera:PATH of a device. Raises SourceError if it cannot be opened or gives no frame."""
    with _capture(rest) as capture:
        read, image = capture.read()
        if not read:
            raise SourceError(f"camera:{rest}: opened, but gives no frame; does another program use it?")
    calibration = calibrator.of(image.shape[1], image.shape[0])

    def frames(first: int) -> Iterator[CapturedFrame]:
        return _frames(rest, first, calibration, config.size)

    return Source(f"camera {rest}, {calibration.told}", "wall", frames)


def _frames(device: str, frame_id: int, calibration: Calibration, size: int | None) -> Iterator[CapturedFrame]:
    camera, origin = calibration.camera, calibration.origin
    with _capture(device) as capture:
        while capture.grab():
            at_ns = time.time_ns()
            read, bgr = capture.retrieve()
            if not read or bgr.shape[:2] != (camera.height, camera.width):
                raise SourceError(f"camera:{device}: gave a frame that cannot be read, or of another size")
            image, resized = shrunk_with_camera(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), camera, size)
            yield CapturedFrame(frame_id, image, "rgb8", resized, f"camera{device}#{frame_id}", at_ns, origin=origin)
            frame_id += 1
    raise SourceError(f"camera:{device}: gives no more frames; is it still plugged in?")


@contextmanager
def _capture(device: str) -> Iterator[cv2.VideoCapture]:
    complaint = f"camera:{device}: no such camera, or no right to use it; see /dev/video*"
    with opened(int(device) if device.isdecimal() else device, complaint) as capture:
        # Else a driver's queue hands out frames that are several periods old.
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        yield capture
