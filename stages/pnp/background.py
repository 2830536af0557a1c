"""What a plain background says of a pose: where the frame shows the background, the object cannot be.

Parts of an object that look alike agree on poses that turn it into itself there. If the rest of the object then lies on
the background, the pose is wrong, however many points were found. What hides the object contradicts nothing.
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
    """The pixels of a frame, shrunk to the size of views, that surely show its plain background.

    sure: (h, w) bool; camera: of the shrunk frame.  colour: (3,) int, the background's.
    """

    sure: Mask
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
        sure = cv2.erode(_from_border(alike), np.ones((2 * constants.NEAR_PX + 1,) * 2, np.uint8))
        return cls(sure.astype(bool), camera, colour)

    def share_on_it(self, points: Points, cam_from_object: Transform) -> float:
        """Of the points (n, 3) of the object that a pose puts into the frame, the share that lies on the background."""
        in_cam = points @ cam_from_object[:3, :3].T + cam_from_object[:3, 3]
        pixels = self.camera.project(in_cam)
        with np.errstate(invalid="ignore"):
            size = (self.camera.width - 0.5, self.camera.height - 0.5)
            inside = (in_cam[:, 2] > 0) & ((pixels >= -0.5) & (pixels < size)).all(axis=1)
        x, y = np.rint(pixels[inside]).astype(np.int64).T
        return float(self.sure[y, x].mean()) if len(x) else 0.0


class Contradiction:
    """Tells whether a frame's background contradicts a pose, for the object as a view shows it."""

    def __init__(self, pictures: Pictures, camera: Camera) -> None:
        self._background = PlainBackground.of(pictures.frame, camera, max(pictures.depth.shape))
        self._points = np.zeros((0, 3)) if self._background is None else _distinct(pictures, self._background.colour)

    def __call__(self, cam_from_object: Transform) -> bool:
        """Whether it does."""
        if self._background is None or len(self._points) < constants.LEAST_DISTINCT:
            return False
        return self._background.share_on_it(self._points, cam_from_object) > constants.CONTRADICTED


def _from_border(alike: np.ndarray) -> np.ndarray:
    """(h, w) uint8 0 or 1: of the marked pixels those that hang together with marked ones of the border."""
    _, label = cv2.connectedComponents(alike, connectivity=4)
    reached = np.zeros(label.max() + 1, np.uint8)
    for side in (label[0], label[-1], label[:, 0], label[:, -1]):
        reached[side] = 1
    reached[0] = 0
    return reached[label]


def _distinct(pictures: Pictures, colour: np.ndarray) -> np.ndarray:
    """Points (n, 3) of the object that the view shows in another colour, one of each few pixels, thin parts too."""
    differs = np.abs(pictures.view.astype(int) - colour).max(axis=2) > constants.DISTINCT
    y, x = np.nonzero((pictures.depth > 0) & differs)
    turn = np.random.default_rng(_SEED).permutation(len(y))
    y, x = y[turn], x[turn]
    cell = y // constants.CELL_PX * pictures.camera.width + x // constants.CELL_PX
    _, one = np.unique(cell, return_index=True)
    pixels = np.stack([x[one], y[one]], axis=1).astype(np.float32)
    depth = pictures.depth[y[one], x[one]]
    return points_at_depth(pictures.camera, pictures.cam_from_object, pixels, depth).astype(np.float64)
