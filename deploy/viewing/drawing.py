"""The camera's image with what the pipeline sees in it: the field's edges at the pose found, and points."""

from __future__ import annotations

from typing import Literal, get_args

import cv2
import numpy as np

from fieldpose.deploy.reporting.overlay import edges_over, overlaid, without_distortion
from fieldpose.deploy.viewing.moments import Moment
from fieldpose.stages.geometry import Camera
from fieldpose.stages.images import shrunk_with_camera
from fieldpose.stages.nerf.rendering_api import RayRenderer, RenderedView
from fieldpose.stages.wire import frame_image

Overlay = Literal["edges", "blend", "difference", "none"]
OVERLAYS: tuple[Overlay, ...] = get_args(Overlay)
FOUND_RGB, LOST_RGB, KEPT_RGB, DISCARDED_RGB = (60, 220, 90), (255, 90, 60), (70, 160, 255), (255, 200, 40)
LEGEND = {
    "followed, found": FOUND_RGB,
    "followed, not found": LOST_RGB,
    "matched, on the surface": KEPT_RGB,
    "matched, discarded as inconsistent": DISCARDED_RGB,
}
_WIDEST = 640


def image_of(moment: Moment) -> tuple[np.ndarray, Camera] | None:
    """The frame (h, w, 3) uint8 without its distortion, its longer side at most 640, and its camera."""
    frame = moment.frame
    image = None if frame is None else frame_image(frame)
    if frame is None or image is None:
        return None
    return shrunk_with_camera(without_distortion(image, frame.camera), frame.camera.undistorted(), _WIDEST)


def drawn(moment: Moment, renderer: RayRenderer | None, overlay: Overlay, points: bool) -> np.ndarray | None:
    """The image of a frame (h, w, 3) uint8 with points, and the field over it where it has a pose; None without one."""
    shown = image_of(moment)
    if shown is None:
        return None
    image, camera = shown
    picture = image.copy()
    if renderer is not None and moment.pose is not None and overlay != "none":
        picture = _over(image, renderer.render_view(camera, moment.pose), overlay)
    if points:
        _points(picture, moment, camera)
    return picture


def _over(image: np.ndarray, view: RenderedView, overlay: Overlay) -> np.ndarray:
    if overlay == "blend":
        return overlaid(image, view)
    if overlay == "edges":
        return edges_over(image, view)
    apart = np.abs(image.astype(np.int16) - view.rgb).astype(np.float32) * view.opacity[..., None]
    return np.minimum(2 * apart, 255).astype(np.uint8)


def _points(picture: np.ndarray, moment: Moment, camera: Camera) -> None:
    if moment.lifted is not None and moment.lifted.header.frame_key == (moment.frame_id, moment.capture_ns):
        kept = moment.lifted.kept
        _dots(picture, moment, camera, moment.lifted.pixels_in_frame[~kept], DISCARDED_RGB)
        _dots(picture, moment, camera, moment.lifted.pixels_in_frame[kept], KEPT_RGB)
    if moment.followed is not None:
        found = moment.followed.found
        _dots(picture, moment, camera, moment.followed.pixels_in_frame[~found], LOST_RGB)
        _dots(picture, moment, camera, moment.followed.pixels_in_frame[found], FOUND_RGB)


def _dots(
    picture: np.ndarray, moment: Moment, camera: Camera, pixels: np.ndarray, colour: tuple[int, int, int]
) -> None:  # fmt: skip
    """pixels (n, 2) are the frame's own; the picture has no distortion and another size, and not all of them."""
    if moment.frame is None or not len(pixels):
        return
    placed = camera.project(moment.frame.camera.directions(pixels))
    inside = (placed > -1).all(axis=1) & (placed < (camera.width, camera.height)).all(axis=1)
    for x, y in np.rint(placed[inside]).astype(int):
        cv2.circle(picture, (int(x), int(y)), 2, colour, -1, cv2.LINE_AA)
