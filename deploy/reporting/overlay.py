"""Pictures and videos of a field rendered over the camera's images."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np

from fieldpose.errors import OutputError
from fieldpose.stages.geometry import Camera
from fieldpose.stages.nerf.rendering_api import RenderedView

EDGE_RGB = (255, 70, 220)
_RENDER_SHARE = 0.45
_EDGE_THRESHOLDS = (80, 180)
_LINE_PX = 20


def overlaid(image: np.ndarray, view: RenderedView) -> np.ndarray:
    """An image (h, w, 3) uint8 with the render laid over it half transparent, and its outlines drawn.

    Where the pose is right, the outlines lie on the image's own edges.
    """
    share = (_RENDER_SHARE * view.opacity)[..., None]
    return edges_over((image * (1 - share) + view.rgb * share).astype(np.uint8), view)


def edges_over(image: np.ndarray, view: RenderedView) -> np.ndarray:
    """An image (h, w, 3) uint8 with the edges of what was rendered, and its outlines."""
    picture = image.copy()
    smooth = cv2.GaussianBlur(cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY), (3, 3), 0)
    edges = cv2.Canny(smooth, *_EDGE_THRESHOLDS) | _outline(view.opacity)
    picture[edges > 0] = EDGE_RGB
    return picture


def _outline(opacity: np.ndarray) -> np.ndarray:
    inside = (opacity > 0.5).astype(np.uint8)
    return cv2.morphologyEx(inside, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) * 255


def captioned(picture: np.ndarray, lines: list[str]) -> np.ndarray:
    """A copy of a picture (h, w, 3) uint8 with lines of text at its top left."""
    picture = picture.copy()
    font, scale = cv2.FONT_HERSHEY_SIMPLEX, 0.45
    for row, line in enumerate(lines):
        width = cv2.getTextSize(line, font, scale, 1)[0][0]
        bottom = (row + 1) * _LINE_PX
        cv2.rectangle(picture, (0, bottom - _LINE_PX), (width + 12, bottom), (0, 0, 0), cv2.FILLED)
        cv2.putText(picture, line, (6, bottom - 6), font, scale, (255, 255, 255), 1, cv2.LINE_AA)
    return picture


def without_distortion(image: np.ndarray, camera: Camera) -> np.ndarray:
    """The image as the camera would take it without its lens distortion."""
    if not any(camera.distortion):
        return image
    return cv2.undistort(image, camera.matrix(), np.array(camera.distortion))


def encoded(picture: np.ndarray, path: Path) -> bytes:
    """A picture (h, w, 3) uint8 RGB as the bytes of a file of the name's kind. Raises OutputError."""
    try:
        written, data = cv2.imencode(path.suffix, cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    except cv2.error:
        written = False
    if not written:
        raise OutputError(f"{path}: no picture can be written under this name; end it in .jpg or .png")
    return data.tobytes()


class VideoFile:
    """A video (.mp4) of pictures (h, w, 3) uint8 RGB of one size, there under its name once it is whole."""

    def __init__(self, path: Path, rate_hz: float, width: int, height: int) -> None:
        self._path = path
        self._partial = path.with_name(f"{path.stem}.partial{path.suffix}")
        path.parent.mkdir(parents=True, exist_ok=True)
        code = cv2.VideoWriter.fourcc(*"mp4v")
        self._writer = cv2.VideoWriter(str(self._partial), code, rate_hz, (width, height))
        if not self._writer.isOpened():
            raise OutputError(f"{path}: OpenCV cannot write this video; end its name in .mp4")

    def add(self, picture: np.ndarray, times: int) -> None:
        """Append a picture so many times."""
        bgr = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
        for _ in range(times):
            self._writer.write(bgr)

    def close(self) -> None:
        """Finish the file."""
        self._writer.release()
        os.replace(self._partial, self._path)

    def discard(self) -> None:
        """Give up what was written."""
        self._writer.release()
        self._partial.unlink()
