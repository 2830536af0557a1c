"""The camera frames of a recording, with the frame numbers, times and true poses that were recorded."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import cast

import numpy as np
from cachetools import FIFOCache

from fieldpose.bus.messages import Frame, Truth
from fieldpose.bus.reading import Recorded, of_another_program, read_recording
from fieldpose.bus.topics import FRAME, TRUTH, Address, key_matches
from fieldpose.errors import RecordingError, SourceError
from fieldpose.stages.camera.calibration import Calibrator
from fieldpose.stages.camera.config import CameraConfig
from fieldpose.stages.camera.core import CapturedFrame, Source, TruePose
from fieldpose.stages.images import shrunk_with_camera
from fieldpose.stages.wire import frame_image

_TRUTH_MAY_LAG = 4
_TRUTHS_KEPT = 64


def open_recording(rest: str, config: CameraConfig, calibrator: Calibrator) -> Source:
    """mcap:FILE, which holds its cameras: config.recorded says whose frames, where these are several.

    Raises SourceError for one without frames of it, and for one of another program.
    """
    wanted = None if config.recorded is None else _address(config.recorded)
    _refuse_others(rest)

    def frames(first: int) -> Iterator[CapturedFrame]:
        return _frames(rest, config.size, wanted, first)

    if next(frames(0), None) is None:
        which = "" if config.recorded is None else f" of {config.recorded}"
        raise SourceError(f"{rest}: no camera frames{which} in this recording; `fieldpose info` lists what it has")
    return Source(f"recording {rest}", "own", frames)


def _refuse_others(path: str) -> None:
    try:
        held = of_another_program(path)
    except RecordingError as error:
        raise SourceError(str(error)) from error
    if held is not None:
        bag = held.startswith("a recording of ros")
        hint = f"--source bag:{path} reads the images of ROS' bags" if bag else "give the recording of fieldpose itself"
        raise SourceError(f"{path}: is {held}; {hint}")


def _address(recorded: str) -> Address:
    object, slash, camera = recorded.partition("/")
    if not (object and slash and camera) or "*" in recorded:
        raise SourceError(f"camera: recorded is {recorded!r}: expected OBJECT/CAMERA, for instance object/camera0")
    return Address("*", object, camera)


def _frames(path: str, size: int | None, wanted: Address | None, first: int) -> Iterator[CapturedFrame]:
    """From the frame at that place on; those whose number has been there before, as all have that a sender did not
    count, are numbered on.
    """
    numbers: set[int] = set()
    largest = 0
    for place, (frame, truth) in enumerate(_with_truths(path, wanted)):
        camera, header = frame.camera, frame.header
        number = header.frame_id if header.frame_id not in numbers else largest + 1
        numbers.add(number)
        largest = max(largest, number)
        if place < first:
            continue
        known = None if truth is None else TruePose(truth.cam_from_object)
        image, encoding = frame.image, frame.encoding
        if size is not None and max(camera.width, camera.height) > size:
            image, camera = shrunk_with_camera(_decoded(frame, path), camera, size)
            encoding = "rgb8"
        yield CapturedFrame(
            number, image, encoding, camera, f"frame {number}", header.capture_ns, known, frame.camera_origin
        )


def _with_truths(path: str, wanted: Address | None) -> Iterator[tuple[Frame, Truth | None]]:
    """Each frame with its truth, which may stand a little before or after it in the file."""
    waiting: deque[Frame] = deque()
    truths: FIFOCache[int, Truth] = FIFOCache(_TRUTHS_KEPT)
    for recorded in _messages(path, wanted):
        if recorded.topic is TRUTH:
            truths[recorded.message.header.frame_id] = cast(Truth, recorded.message)
        else:
            waiting.append(cast(Frame, recorded.message))
        while waiting and (waiting[0].header.frame_id in truths or len(waiting) > _TRUTH_MAY_LAG):
            frame = waiting.popleft()
            yield frame, truths.pop(frame.header.frame_id, None)
    for frame in waiting:
        yield frame, truths.pop(frame.header.frame_id, None)


def _messages(path: str, wanted: Address | None) -> Iterator[Recorded]:
    keys: dict[str, str] = {}
    try:
        for recorded in read_recording(path, (FRAME, TRUTH)):
            if wanted is not None and not key_matches(wanted.key(recorded.topic), recorded.key):
                continue
            if keys.setdefault(recorded.topic.name, recorded.key) != recorded.key:
                both = f"{keys[recorded.topic.name]} and {recorded.key}"
                raise SourceError(f"{path}: holds {both}; choose one with --camera.recorded OBJECT/CAMERA")
            yield recorded
    except RecordingError as error:
        raise SourceError(str(error)) from error


def _decoded(frame: Frame, path: str) -> np.ndarray:
    image = frame_image(frame)
    if image is None:
        raise SourceError(f"{path}: the {frame.encoding} image of frame {frame.header.frame_id} cannot be read")
    return image
