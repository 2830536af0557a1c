"""Polycam's raw data: keyframes/cameras/*.json beside keyframes/images/*.jpg, ARKit's axes with y up.

Source: the description of the format in Polycam's polyform.
"""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np

from fieldpose.errors import DatasetError
from fieldpose.stages.geometry import inverse
from fieldpose.stages.nerf.datasets.assemble import Draft, Holdout, split_of
from fieldpose.stages.nerf.datasets.frames import OPENCV_FROM_OPENGL, find_image, relative_name
from fieldpose.stages.nerf.datasets.images import is_image_name
from fieldpose.stages.nerf.datasets.intrinsics import checked_camera, fitted
from fieldpose.stages.nerf.datasets.parsing import checked_rigid, left_out, read_json
from fieldpose.stages.nerf.datasets.records import ImageRecord

PIXEL_CENTRE = 0.5
"""ARKit's principal points are distances from the image's corner."""
Z_UP_FROM_Y_UP = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""Axes change places, as nerfstudio has it: x of the dataset is z of the recording, y is x, and z is y."""
_KEYFRAMES, _DEPTHS, _METRES_PER_STEP = "keyframes", "depth", 0.001
_SETS = (("corrected_images", "corrected_cameras"), ("images", "cameras"))


class Keyframe(msgspec.Struct):
    """The camera of an image, and three rows of its object_from_cam."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    t_00: float
    t_01: float
    t_02: float
    t_03: float
    t_10: float
    t_11: float
    t_12: float
    t_13: float
    t_20: float
    t_21: float
    t_22: float
    t_23: float


def is_polycam(root: Path) -> bool:
    """Whether a folder has Polycam's keyframes in it."""
    return any((root / _KEYFRAMES / cameras).is_dir() for _, cameras in _SETS)


def read_polycam(root: Path, holdout: Holdout | None) -> Draft:
    """All images that have a camera, in metres and with z up; "auto" holds out every eighth. Raises DatasetError.

    Corrected images with their cameras are preferred, which are undistorted and whose poses were adjusted to each
    other. Depth is the LiDAR's, at its own lower resolution, whatever its confidence.
    """
    images, cameras = _chosen(root)
    paths = sorted(path for path in images.iterdir() if is_image_name(path))
    bare = [relative_name(root, path) for path in paths if not (cameras / f"{path.stem}.json").is_file()]
    posed = [path for path in paths if (cameras / f"{path.stem}.json").is_file()]
    if not posed:
        raise DatasetError(f"{cameras}: no camera for an image of {images.name}; export the raw data again")
    rule: Holdout | None = "every8" if holdout == "auto" else holdout
    records = [_record(root, path, cameras / f"{path.stem}.json", rule, i) for i, path in enumerate(posed)]
    notes = left_out(len(paths), bare, f"not in {cameras.name}")
    if images.name == _SETS[0][0]:
        notes += ("corrected images are read; the narrow black border that some have is learnt with them",)
    else:
        notes += (
            "images are read as they were taken, since there are no corrected ones: their lens and the drift of their"
            " poses are not corrected",
        )
    return Draft("polycam", records, metres_per_unit=1.0, unit="m", notes=notes)


def _chosen(root: Path) -> tuple[Path, Path]:
    for images, cameras in _SETS:
        pair = root / _KEYFRAMES / images, root / _KEYFRAMES / cameras
        if all(folder.is_dir() and any(folder.iterdir()) for folder in pair):
            return pair
    raise DatasetError(f"{root / _KEYFRAMES}: no images with cameras in it; export the raw data again")


def _record(root: Path, path: Path, file: Path, rule: Holdout | None, index: int) -> ImageRecord:
    frame = read_json(file, Keyframe)
    where = str(file)
    camera = checked_camera(
        where, frame.width, frame.height, (frame.fx, frame.fy), (frame.cx - PIXEL_CENTRE, frame.cy - PIXEL_CENTRE)
    )
    stored = np.array(
        [
            [frame.t_00, frame.t_01, frame.t_02, frame.t_03],
            [frame.t_10, frame.t_11, frame.t_12, frame.t_13],
            [frame.t_20, frame.t_21, frame.t_22, frame.t_23],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
    object_from_cam = Z_UP_FROM_Y_UP @ checked_rigid(stored, where) @ OPENCV_FROM_OPENGL
    depth = find_image(root / _KEYFRAMES, f"{_DEPTHS}/{path.stem}.png")
    return ImageRecord(
        relative_name(root, path), path, fitted(path, camera), inverse(object_from_cam), split_of(index, rule),
        depth_path=depth, depth_scale=None if depth is None else _METRES_PER_STEP,
    )  # fmt: skip
