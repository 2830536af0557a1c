"""A picture and a video of a recorded run: the field rendered at each pose found, over the camera's images."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np

from fieldpose.bus.messages import Frame
from fieldpose.bus.reading import read_recording
from fieldpose.bus.topics import FRAME, Address
from fieldpose.deploy.reporting.overlay import VideoFile, captioned, overlaid, without_distortion
from fieldpose.deploy.reporting.results import FrameResult
from fieldpose.stages.geometry import Camera
from fieldpose.stages.images import shrunk_with_camera
from fieldpose.stages.nerf.rendering_api import RayRenderer
from fieldpose.stages.wire import frame_image

_VIDEO_HZ = 30.0
_WIDEST = 480
_LONGEST_STILL_S = 1.0


@dataclass(frozen=True)
class Picture:
    """Two images (h, 2 w, 3) uint8 RGB side by side: the camera's, and the same with the field over it."""

    pixels: np.ndarray
    result: FrameResult


def pictures(
    recording: Path,
    results: Sequence[FrameResult],
    renderer: RayRenderer,
    report: Callable[[int, int], None] = lambda done, total: None,
    address: Address | None = None,
) -> Iterator[Picture]:
    """The recorded frames that were worked on, in order; those without a pose show the camera's image alone.

    address: of the pipeline that the results are of, where the recording holds several.

    Raises RecordingError.
    """
    finished = [result for result in results if result.outcome == "finished"]
    for done, picture in enumerate(pictures_of(recording, finished, renderer, address), 1):
        yield picture
        report(done, len(finished))


def pictures_of(
    recording: Path, results: Sequence[FrameResult], renderer: RayRenderer, address: Address | None = None
) -> Iterator[Picture]:
    """As `pictures`, of all these frames, whatever became of them; of those that cannot be decoded there is none."""
    wanted = {(result.frame_id, result.capture_ns): result for result in results}
    for recorded in read_recording(recording, (FRAME,)):
        if address is not None and not address.covers(recorded.key):
            continue
        frame = cast(Frame, recorded.message)
        result = wanted.pop(frame.header.frame_key, None)
        image = None if result is None else frame_image(frame)
        if result is not None and image is not None:
            yield _picture(image, frame.camera, result, renderer)


def write_video(path: Path, shown: Iterator[Picture]) -> Picture | None:
    """Write pictures at the pace that their frames were taken; returns the one with the best pose, if any.

    A frame stays on screen until the next one that was worked on.
    """
    video: VideoFile | None = None
    best: Picture | None = None
    before: Picture | None = None
    try:
        for picture in shown:
            if video is None:
                video = VideoFile(path, _VIDEO_HZ, picture.pixels.shape[1], picture.pixels.shape[0])
            if before is not None:
                video.add(before.pixels, _repeats(before, picture))
            before = picture
            if best is None or picture.result.score > best.result.score:
                best = picture
    except BaseException:
        if video is not None:
            video.discard()
        raise
    if video is not None and before is not None:
        video.add(before.pixels, 1)
        video.close()
    return best


def _repeats(picture: Picture, following: Picture) -> int:
    seconds = (following.result.capture_ns - picture.result.capture_ns) / 1e9
    return max(1, round(min(seconds, _LONGEST_STILL_S) * _VIDEO_HZ))


def _picture(image: np.ndarray, camera: Camera, result: FrameResult, renderer: RayRenderer) -> Picture:
    image = without_distortion(image, camera)
    image, small = shrunk_with_camera(image, camera.undistorted(), _WIDEST)
    over = image
    if result.cam_from_object is not None:
        over = overlaid(image, renderer.render_view(small, result.cam_from_object))
    both = np.concatenate([captioned(image, ["camera"]), captioned(over, _caption(result))], axis=1)
    # Video files want even sizes.
    return Picture(both[: both.shape[0] // 2 * 2, : both.shape[1] // 2 * 2], result)


def _caption(result: FrameResult) -> list[str]:
    lines = [f"{result.state}" if result.cam_from_object is not None else f"{result.state}: no pose"]
    if result.errors is not None:
        lines.append(f"error {result.errors[0]:.2f} deg, {result.errors[1]:.4f} units")
    return lines
