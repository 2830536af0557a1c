"""What a plain background says of a pose: where the frame shows it, the object cannot be, and elsewhere it has to be.

Parts of an object that look alike agree on poses that turn it into itself there. If the rest of the object then lies on
the background, and what the frame shows is not where the object would be, the pose is wrong, however many points were
found. A little of one of the two alone contradicts nothing: a field of few photographs has shreds in the air, which lie
on the background, and what hides the object is where the object is not.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from fieldpose.stages.geometry import Camera, points_at_depth
from fieldpose.stages.geometry.arrays import FrameImage, Mask, Points, Transform
from fieldpose.stages.images import shrunk_with_camera
from fieldpose.stages.pnp import constants
from fieldpose.stages.pnp.aligner import Pictures

_SEED = 0


@dataclass(frozen=True)
class PlainBackground:
    """Of the pixels of a frame, shrunk to the size of views, those that surely show its plain background.

    sure: (h, w) bool; other (h, w): those that surely do not. camera: of the shrunk frame.  colour: (3,) int, the
    background's.
    """

    sure: Mask
    other: Mask
    camera: Camera
    colour: np.ndarray

    @classmethod
    def of(cls, frame: FrameImage, camera: Camera, longer_side: int) -> PlainBackground | None:
        """None where the frame's border has not one colour, as on most backgrounds but studios' and renderings'."""
        image, camera = shrunk_with_camera(frame, camera, longer_side)
        border = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]]).astype(int)
        colour = np.rint(np.median(border, axis=0)).astype(int)
        if (np.abs(border - colour).max(axis=1) <= constants.PLAIN).mean() < constants.PLAIN_BORDER:
            return None
        low, high = colour - constants.PLAIN, colour + constants.PLAIN
        alike = cv2.inRange(image, low.astype(np.float64), high.astype(np.float64))
        background = _from_border(alike)
        sure = cv2.erode(background, np.ones((2 * constants.NEAR_PX + 1,) * 2, np.uint8)).astype(bool)
        distinct = np.abs(image.astype(np.int16) - colour).max(axis=2) > constants.DISTINCT
        return cls(sure, distinct & (background == 0), camera, colour)

    def share_on_it(self, points: Points, cam_from_object: Transform) -> float:
        """Of the points (n, 3) of the object that a pose puts into the frame, the share that lies on the background."""
        x, y = self._pixels(points, cam_from_object)
        return float(self.sure[y, x].mean()) if len(x) else 0.0

    def share_unexplained(self, points: Points, cam_from_object: Transform) -> float:
        """Of the pixels that show something else, the share that none of the points (n, 3) of the object is near."""
        x, y = self._pixels(points, cam_from_object)
        explained = np.zeros(self.other.shape, np.uint8)
        explained[y, x] = 1
        near = cv2.dilate(explained, np.ones((2 * constants.EXPLAINS_PX + 1,) * 2, np.uint8)) > 0
        return float((~near)[self.other].mean()) if self.other.any() else 0.0

    def _pixels(self, points: Points, cam_from_object: Transform) -> tuple[np.ndarray, np.ndarray]:
        """Columns and rows of the points that a pose puts into the frame."""
        in_cam = points @ cam_from_object[:3, :3].T + cam_from_object[:3, 3]
        pixels = self.camera.project(in_cam)
        with np.errstate(invalid="ignore"):
            size = (self.camera.width - 0.5, self.camera.height - 0.5)
            inside = (in_cam[:, 2] > 0) & ((pixels >= -0.5) & (pixels < size)).all(axis=1)
        x, y = np.rint(pixels[inside]).astype(np.int64).T
        return x, y


class Contradiction:
    """Tells whether a frame's background contradicts a pose, for the object as a view shows it."""

    def __init__(self, pictures: Pictures, camera: Camera) -> None:
        self._background = PlainBackground.of(pictures.frame, camera, max(pictures.depth.shape))
        self._shown, self._distinct = np.zeros((0, 3)), np.zeros((0, 3))
        if self._background is not None:
            self._shown = _points(pictures, pictures.depth > 0, constants.SPARSE_PX)
            differs = np.abs(pictures.view.astype(np.int16) - self._background.colour).max(axis=2) > constants.DISTINCT
            self._distinct = _points(pictures, (pictures.depth > 0) & differs, constants.CELL_PX)

    def __call__(self, cam_from_object: Transform) -> bool:
        """Whether it does, by what of the object lies on the background, and what the frame shows of it elsewhere."""
        if self._background is None or len(self._distinct) < constants.LEAST_DISTINCT:
            return False
        on_it = self._background.share_on_it(self._distinct, cam_from_object)
        if 2 * on_it <= constants.CONTRADICTED:
            return False
        if on_it > constants.OFF_IT:
            return True
        unexplained = self._background.share_unexplained(self._shown, cam_from_object)
        return 2 * on_it * unexplained > constants.CONTRADICTED * (on_it + unexplained)


def _from_border(alike: np.ndarray) -> np.ndarray:
    """(h, w) uint8 0 or 1: of the marked pixels those that hang together with marked ones of the border."""
    _, label = cv2.connectedComponents(alike, connectivity=4)
    reached = np.zeros(label.max() + 1, np.uint8)
    for side in (label[0], label[-1], label[:, 0], label[:, -1]):
        reached[side] = 1
    reached[0] = 0
    return reached[label]


def _points(pictures: Pictures, of: Mask, cell_px: int) -> np.ndarray:
    """Points (n, 3) of the object at some of the view's pixels, one in each cell of that side, thin parts too."""
    y, x = np.nonzero(of)
    turn = np.random.default_rng(_SEED).permutation(len(y))
    y, x = y[turn], x[turn]
    _, one = np.unique(y // cell_px * pictures.camera.width + x // cell_px, return_index=True)
    pixels = np.stack([x[one], y[one]], axis=1).astype(np.float32)
    depth = pictures.depth[y[one], x[one]]
    return points_at_depth(pictures.camera, pictures.cam_from_object, pixels, depth).astype(np.float64)
