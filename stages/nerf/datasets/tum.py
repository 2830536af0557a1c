"""TUM RGB-D: rgb.txt lists the images and groundtruth.txt poses by their times, from a motion capture system.

Source: Sturm and others, A benchmark for the evaluation of RGB-D SLAM systems (2012).
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from fieldpose.errors import DatasetError
from fieldpose.stages.geometry import Camera, inverse
from fieldpose.stages.geometry.rigid import from_rotation
from fieldpose.stages.nerf.datasets.assemble import Draft, Holdout, split_of
from fieldpose.stages.nerf.datasets.frames import check_distinct, find_image, relative_name
from fieldpose.stages.nerf.datasets.intrinsics import fitted
from fieldpose.stages.nerf.datasets.parsing import (
    CAMERA_FILE,
    camera_beside,
    left_out,
    numbers,
    posed_by_quaternion,
    read_rows,
)
from fieldpose.stages.nerf.datasets.records import ImageRecord

FILE, POSES, DEPTHS = "rgb.txt", "groundtruth.txt", "depth.txt"
CAMERAS = {
    "1": Camera(640, 480, 517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": Camera(640, 480, 520.9, 521.0, 325.1, 249.7, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": Camera(640, 480, 535.4, 539.2, 320.1, 247.6),
}
"""The colour cameras of freiburg1, 2 and 3 as the benchmark has calibrated them; 3's images are undistorted."""
LONGEST_GAP_S = 0.1
"""Between two poses; what an image shows within a longer one is not known."""
DEPTH_WITHIN_S, METRES_PER_STEP = 0.02, 1 / 5000
_CAMERA_NAME = re.compile(r"(?:freiburg|fr)([123])(?!\d)")
_AN_IMAGE, _A_POSE = "a time and a path", "a time, x, y, z and a quaternion x, y, z, w"


def read_tum(root: Path, holdout: Holdout | None) -> Draft:
    """All images between whose neighbouring poses no more than LONGEST_GAP_S lie, in metres, sorted by time.

    Poses are stored as object_from_cam in OpenCV's camera axes, and interpolated. "auto" holds out every eighth image.
    The camera is that of camera.json, if that is there, else the one that the folder's name tells. Raises DatasetError.
    """
    camera, notes = _camera(root)
    listed = _images(root, root / FILE)
    times = np.array([time for time, _ in listed])
    poses, known = _interpolated(root / POSES, times)
    lost = [relative_name(root, path) for (_, path), good in zip(listed, known, strict=True) if not good]
    if not known.any():
        raise DatasetError(f"{root / POSES}: no image of {FILE} is between two of its poses; are they of one sequence?")
    depths = _images(root, root / DEPTHS) if (root / DEPTHS).is_file() else []
    rule: Holdout | None = "every8" if holdout == "auto" else holdout
    records = []
    for i, k in enumerate(np.flatnonzero(known)):
        path, depth = listed[k][1], _nearest(depths, times[k])
        records.append(
            ImageRecord(
                relative_name(root, path), path, fitted(path, camera), inverse(poses[k]), split_of(i, rule),
                depth_path=depth, depth_scale=None if depth is None else METRES_PER_STEP,
            )
        )  # fmt: skip
    check_distinct(root / FILE, records)
    notes += left_out(len(listed), lost, f"no poses within {LONGEST_GAP_S:g} s of each other are around")
    return Draft("tum", records, metres_per_unit=1.0, unit="m", notes=notes)


def _camera(root: Path) -> tuple[Camera, tuple[str, ...]]:
    given = camera_beside(root)
    if given is not None:
        return given, ()
    name = root.resolve().name
    named = _CAMERA_NAME.search(name)
    if named is None:
        raise DatasetError(
            f"{root}: its name tells no camera of TUM RGB-D (freiburg1, freiburg2 or freiburg3); write the calibration"
            f" into {root / CAMERA_FILE}, or rename the folder"
        )
    return CAMERAS[named[1]], (f"the camera is the one published for freiburg{named[1]}, as the folder's name tells",)


def _images(root: Path, file: Path) -> list[tuple[float, Path]]:
    """Times and paths, sorted by time."""
    listed = []
    for where, words in read_rows(file, 2, _AN_IMAGE):
        path = find_image(root, words[1])
        if path is None:
            raise DatasetError(f"{where}: no image {words[1]} in {root}; restore it, or take its line out")
        listed.append((_time(where, words[0]), path))
    return sorted(listed)


def _interpolated(file: Path, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """object_from_cam (n, 4, 4) at times (n,), and which of them are known (n,)."""
    from scipy.spatial.transform import Rotation

    rows = []
    for where, words in read_rows(file, 8, _A_POSE):
        values = numbers(where, words[1:8])
        rows.append((_time(where, words[0]), posed_by_quaternion(where, values[3:], values[:3])))
    rows.sort(key=lambda row: row[0])
    at, poses = np.array([row[0] for row in rows]), np.stack([row[1] for row in rows])
    before = np.clip(np.searchsorted(at, times, "right") - 1, 0, None)
    after = np.where(times > at[before], np.minimum(before + 1, len(at) - 1), before)
    gap = at[after] - at[before]
    known = (at[before] <= times) & (times <= at[after]) & (gap <= LONGEST_GAP_S)
    share = np.divide(times - at[before], gap, out=np.zeros_like(times), where=gap > 0)
    first, last = (Rotation.from_matrix(poses[i, :3, :3]) for i in (before, after))
    rotations = first * Rotation.from_rotvec(share[:, None] * (first.inv() * last).as_rotvec())
    places = poses[before, :3, 3] + share[:, None] * (poses[after, :3, 3] - poses[before, :3, 3])
    return np.stack([from_rotation(r, place) for r, place in zip(rotations, places, strict=True)]), known


def _nearest(depths: list[tuple[float, Path]], time: float) -> Path | None:
    """The depth image of a time, as the benchmark's own programs associate them."""
    if not depths:
        return None
    i = int(np.argmin([abs(at - time) for at, _ in depths]))
    return depths[i][1] if abs(depths[i][0] - time) <= DEPTH_WITHIN_S else None


def _time(where: str, word: str) -> float:
    (time,) = numbers(where, [word])
    if not np.isfinite(time):
        raise DatasetError(f"{where}: the time {word} is not finite; take the line out")
    return time
