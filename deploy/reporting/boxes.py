"""Pictures of a box around an object, drawn into what cameras see of it."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import cv2
import numpy as np

from fieldpose.stages.geometry import Camera

EDGE_RGB = (255, 70, 220)
_HALO_RGB = (20, 20, 20)
_STEPS = 64
_NEAREST, _FARTHEST_PX = 1e-3, 1e4
_HEIGHT, _GAP = 360, 6
Pixel = tuple[int, int]


def boxed(image: np.ndarray, camera: Camera, cam_from_object: np.ndarray, box: np.ndarray) -> np.ndarray:
    """A copy of an image with the edges of a box (2, 3), lowest and highest corner, that the camera sees."""
    picture = np.ascontiguousarray(image).copy()
    width = max(1, round(max(image.shape[:2]) / 300))
    segments = [segment for line in _edges(box) for segment in _seen(line, camera, cam_from_object)]
    for colour, thickness in ((_HALO_RGB, width + 2), (EDGE_RGB, width)):
        for first, second in segments:
            cv2.line(picture, first, second, colour, thickness, cv2.LINE_AA)
    return picture


def sheet(pictures: Sequence[np.ndarray], columns: int = 3, height: int = _HEIGHT) -> np.ndarray:
    """Pictures (h, w, 3) uint8 beside and below each other, all as high, on white."""
    shrunk = []
    for picture in pictures:
        scale = height / picture.shape[0]
        size = max(1, round(picture.shape[1] * scale)), height
        shrunk.append(cv2.resize(picture, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR))
    rows = [shrunk[i : i + columns] for i in range(0, len(shrunk), columns)]
    across = max(sum(p.shape[1] + _GAP for p in row) - _GAP for row in rows)
    whole = np.full((len(rows) * (height + _GAP) - _GAP, across, 3), 255, np.uint8)
    for i, row in enumerate(rows):
        left = 0
        for picture in row:
            whole[i * (height + _GAP) :][:height, left : left + picture.shape[1]] = picture
            left += picture.shape[1] + _GAP
    return whole


def _seen(line: np.ndarray, camera: Camera, cam_from_object: np.ndarray) -> list[tuple[Pixel, Pixel]]:
    """The pieces of a line of points (n, 3) that are before the camera, from pixel to pixel."""
    in_cam = line @ cam_from_object[:3, :3].T + cam_from_object[:3, 3]
    ahead = in_cam[:, 2] > _NEAREST * np.abs(in_cam).max()
    pixels = np.rint(np.clip(camera.project(np.where(ahead[:, None], in_cam, 1.0)), -_FARTHEST_PX, _FARTHEST_PX))
    ends = [(int(x), int(y)) for x, y in pixels]
    return [(ends[i], ends[i + 1]) for i in range(len(line) - 1) if ahead[i] and ahead[i + 1]]


def _edges(box: np.ndarray) -> list[np.ndarray]:
    """The twelve edges, each as points (_STEPS + 1, 3) along it: through a lens they are no straight lines."""
    corners = np.array(list(itertools.product((0, 1), repeat=3)))
    share = np.linspace(0, 1, _STEPS + 1)[:, None]
    return [
        box[0] + ((1 - share) * a + share * b) * (box[1] - box[0])
        for a, b in itertools.combinations(corners, 2)
        if np.abs(a - b).sum() == 1
    ]
