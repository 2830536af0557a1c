"""Square markers of known size in photographs: what a metre is there, and where the object stands.

Sources: Garrido-Jurado and others, Automatic generation and detection of highly reliable fiducial markers (2014);
Olson, AprilTag (2011); both as OpenCV has them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from fieldpose.stages.geometry import Similarity
from fieldpose.stages.geometry.arrays import Matrix3, Points64
from fieldpose.stages.structure.posed import PosedCameras
from fieldpose.stages.structure.tracks import Tracks
from fieldpose.stages.structure.triangulation import triangulate

DICTIONARIES: Mapping[str, str] = {
    "4x4": "DICT_4X4_1000", "5x5": "DICT_5X5_1000", "6x6": "DICT_6X6_1000", "7x7": "DICT_7X7_1000",
    "aruco": "DICT_ARUCO_ORIGINAL", "tag16h5": "DICT_APRILTAG_16H5", "tag25h9": "DICT_APRILTAG_25H9",
    "tag36h11": "DICT_APRILTAG_36H11",
}  # fmt: skip
FEWEST = 3
"""Images that a marker is to be seen in."""
_SKEWED = 0.05
"""How far the sides of a marker may differ, as a share: more is no flat square."""


@dataclass(frozen=True, eq=False)
class Seen:
    """A marker in an image: its number, and its corners (4, 2) in pixels, clockwise from its own top left."""

    number: int
    corners: np.ndarray


@dataclass(frozen=True, eq=False)
class Marker:
    """object_from_map: into metres, x to the marker's right, y to its top, z out of it, origin at its middle.

    images: how many show it.  error_px: median distance of its corners from where they are seen.
    """

    number: int
    object_from_map: Similarity
    images: int
    error_px: float


def find_markers(image: np.ndarray, family: str) -> list[Seen]:
    """The markers of a family (see DICTIONARIES) in an image (h, w, 3) uint8."""
    # OpenCV's first pixel has its centre at 0 here, as ours.
    aruco: Any = cv2.aruco
    parameters = aruco.DetectorParameters()
    parameters.cornerRefinementMethod = aruco.CORNER_REFINE_SUBPIX
    dictionary = aruco.getPredefinedDictionary(getattr(aruco, DICTIONARIES[family]))
    found, numbers, _ = aruco.ArucoDetector(dictionary, parameters).detectMarkers(
        cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    )
    if numbers is None:
        return []
    return [Seen(int(n), c.reshape(4, 2).astype(np.float64)) for n, c in zip(numbers.ravel(), found, strict=True)]


def place_marker(posed: PosedCameras, seen: Sequence[Sequence[Seen]], size: float) -> Marker | None:
    """The frame and unit of the marker that most images show, whose sides are `size` metres; None where none will do.

    seen: of each image. A marker that an image shows twice counts for nothing there.
    """
    counts: dict[int, int] = {}
    for markers in seen:
        for number in _once(markers):
            counts[number] = counts.get(number, 0) + 1
    for number in sorted(counts, key=lambda n: (-counts[n], n)):
        if counts[number] < FEWEST:
            return None
        marker = _placed(posed, seen, number, size)
        if marker is not None:
            return marker
    return None


def _once(markers: Sequence[Seen]) -> set[int]:
    numbers = [marker.number for marker in markers]
    return {number for number in numbers if numbers.count(number) == 1}


def _placed(posed: PosedCameras, seen: Sequence[Sequence[Seen]], number: int, size: float) -> Marker | None:
    images = [(i, m.corners) for i, markers in enumerate(seen) for m in markers if m.number == number]
    images = [(i, corners) for i, corners in images if number in _once(seen[i])]
    index, pixels = np.array([i for i, _ in images]), np.stack([corners for _, corners in images])
    count = len(index)
    tracks = Tracks(np.repeat(np.arange(4), count), np.tile(index, 4), pixels.transpose(1, 0, 2).reshape(-1, 2))
    found = triangulate(posed, tracks)
    corners = found.points
    sides = np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1)
    side = float(sides.mean())
    if not np.isfinite(corners).all() or side <= 0 or np.abs(sides / side - 1).max() > _SKEWED:
        return None
    rotation = _axes(corners)
    scale = size / side
    to_marker = Similarity(scale, rotation, -scale * rotation @ corners.mean(axis=0))
    return Marker(number, to_marker, count, float(np.median(found.error_px)))


def _axes(corners: Points64) -> Matrix3:
    """Rows: right, up and out of a square whose corners go clockwise from its top left."""
    right = corners[1] + corners[2] - corners[0] - corners[3]
    right = right / np.linalg.norm(right)
    up = corners[0] + corners[1] - corners[2] - corners[3]
    up = up - (up @ right) * right
    up = up / np.linalg.norm(up)
    return np.stack([right, up, np.cross(right, up)])
