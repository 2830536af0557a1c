"""In which axes poses were meant that do not fit their images as they were read.

Files say nothing of it: some programs write OpenGL's camera axes, others OpenCV's, and camera-to-world or its inverse.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from fieldpose.stages.geometry.arrays import Transforms
from fieldpose.stages.structure.features import Keypoints
from fieldpose.stages.structure.matches import match_pairs
from fieldpose.stages.structure.pairs import alike_pairs
from fieldpose.stages.structure.posed import PosedCameras
from fieldpose.stages.structure.tracks import join_tracks
from fieldpose.stages.structure.triangulation import triangulate

_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
READINGS: Mapping[str, Callable[[Transforms], Transforms]] = {
    "object_from_cam in OpenCV's camera axes (x right, y down, z ahead)": lambda pose: _FLIP @ pose,
    "cam_from_object in OpenCV's camera axes (x right, y down, z ahead)": lambda pose: np.linalg.inv(pose) @ _FLIP,
    "cam_from_object in OpenGL's camera axes (x right, y up, z back)": lambda pose: _FLIP @ np.linalg.inv(pose) @ _FLIP,
}
"""What a matrix may have been meant to be that was read as object_from_cam in OpenGL's camera axes: from the
cam_from_object (n, 4, 4) that it was read as to the one that was meant."""
_PARTNERS = 6
_BETTER = 0.25
"""Of the error as read: another reading that leaves less is the right one."""
_FITTING_PX = 6.0
_FEWEST_TRACKS = 30


def fitting_reading(
    given: PosedCameras, keypoints: Sequence[Keypoints], threads: int, report: Callable[[float], None]
) -> str | None:
    """Which of READINGS makes cameras fit what their images share; None where none does, or they share too little."""
    pairs = alike_pairs(keypoints, _PARTNERS)
    tracks = join_tracks(keypoints, pairs, match_pairs(keypoints, pairs, threads, report))
    if tracks.count < _FEWEST_TRACKS:
        return None

    def error_px(poses: Transforms) -> float:
        return float(np.median(triangulate(PosedCameras(given.cameras, poses), tracks).error_px))

    errors = {name: error_px(read(given.cam_from_object)) for name, read in READINGS.items()}
    best = min(errors, key=errors.__getitem__)
    fits = errors[best] < min(_FITTING_PX, _BETTER * error_px(given.cam_from_object))
    return best if fits else None
