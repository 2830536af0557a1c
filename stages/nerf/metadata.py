"""What a field file says about itself, besides its arrays."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import msgspec
import numpy as np

from fieldpose.stages.geometry import RIGID_TOLERANCE, Camera, Similarity, is_rigid
from fieldpose.stages.geometry.rigid import from_rotation
from fieldpose.stages.nerf.config import FieldConfig

FORMAT_VERSION = 1
DESCRIBED_SIZE = 400
"""Longer side to which larger images are shrunk before they are described."""

Rows3 = tuple[float, float, float, float, float, float, float, float, float]
"""A 3x3 matrix by rows."""
Corners = tuple[float, float, float, float, float, float]
"""The lowest and the highest corner of a box: x y z x y z."""
UNTURNED: Rows3 = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


class Space(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """From object coordinates to the field's: y = rotation (x - centre) / scale.

    A bounded field fills the box |y| <= half; a contracted one all space, the unit ball at full resolution; either one
    only `box`, its lowest and its highest corner, where that is given. `near`, `far` and `step` are lengths in y.
    """

    contracted: bool
    centre: tuple[float, float, float]
    scale: float
    half: tuple[float, float, float] = (1.0, 1.0, 1.0)
    near: float = 0.0
    far: float = 8.0
    step: float = 2.0 / 384
    rotation: Rows3 = UNTURNED
    box: Corners | None = None

    @property
    def corners(self) -> np.ndarray | None:
        """The box (2, 3) float64 in y that everything is in; None where there is none."""
        if self.box is not None:
            return np.reshape(np.array(self.box, np.float64), (2, 3))
        if self.contracted:
            return None
        half = np.array(self.half, np.float64)
        return np.stack([-half, half])

    @property
    def turn(self) -> np.ndarray:
        """rotation as a matrix (3, 3) float64."""
        return np.reshape(np.array(self.rotation, np.float64), (3, 3))


class Frame(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """From the dataset's coordinates to those that the field is used by: x = scale * rotation d + translation.

    unit and metres_per_unit: the dataset's, where frame or unit of the field have been changed; unit is None where not.
    """

    scale: float = 1.0
    rotation: Rows3 = UNTURNED
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    unit: str | None = None
    metres_per_unit: float | None = None

    @property
    def object_from_dataset(self) -> Similarity:
        """As a similarity."""
        return Similarity(self.scale, np.reshape(np.array(self.rotation), (3, 3)), np.array(self.translation))


class TrainingCamera(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A training view: its name, intrinsics at the size trained on, and pose (row-major 4x4, OpenCV axes)."""

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float]
    cam_from_object: tuple[float, ...]

    @property
    def camera(self) -> Camera:
        """Its camera. Raises GeometryError where the intrinsics make none."""
        return Camera(self.width, self.height, self.fx, self.fy, self.cx, self.cy, self.distortion)

    @property
    def pose(self) -> np.ndarray:
        """cam_from_object (4, 4) float64."""
        return np.reshape(np.array(self.cam_from_object, np.float64), (4, 4))


class PoseAccuracy(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How well poses of a field's own training images are found, each from the training view next to it.

    Of `images` that many were `found`, with these medians of the errors. error_scale: how many times larger errors are
    than covariances say, with an allowance for images that the field was not learnt from.
    """

    images: int
    found: int
    rotation_deg: float
    translation: float
    error_scale: float


class CameraFit(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How the dataset's cameras fitted their images before the training, and how far they were moved to fit.

    verdict: "fit", they were kept; "adjusted"; "too few" images share enough, or "no fit" was found, and they were
    kept. before_px and after_px: median distance of points from where they are seen, by the given cameras and by
    adjusted ones, in images whose longer side has size_px. rotation_deg and translation (object units): median and most
    of what the poses were changed by. focal_px: in the median of the images, at the size of their files, before and
    after. kept: images that share too little with others, whose cameras stayed. reading: what the poses in the files
    were meant to be, where they do not fit as object_from_cam in OpenGL's camera axes but would so.
    """

    verdict: Literal["fit", "adjusted", "too few", "no fit"]
    size_px: int
    focal_px: tuple[float, float]
    before_px: float | None = None
    after_px: float | None = None
    rotation_deg: tuple[float, float] | None = None
    translation: tuple[float, float] | None = None
    kept: tuple[str, ...] = ()
    reading: str | None = None


class FieldMetadata(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Stored as JSON beside the arrays of a field.

    error_scale: see PoseAccuracy; of the field that this is a part of, where it has not been tried itself.
    """

    space: Space
    config: FieldConfig
    background: tuple[float, float, float]
    cameras: list[TrainingCamera]
    dataset_kind: str
    dataset_sha256: str
    unit: str = "dataset unit"
    metres_per_unit: float | None = None
    frame: Frame = Frame()
    has_background: bool = True
    psnr_db: float | None = None
    accuracy: PoseAccuracy | None = None
    camera_fit: CameraFit | None = None
    error_scale: float | None = None
    trained_seconds: float = 0.0
    trained_steps: int = 0
    made_by: str = ""
    version: int = FORMAT_VERSION


_LARGEST = 1e15
_RANGES: dict[str, tuple[float, float]] = {
    "config.levels": (1, 32),
    "config.level_features": (1, 16),
    "config.log2_table": (1, 24),
    "config.base_resolution": (1, 1 << 16),
    "config.finest_resolution": (1, 1 << 20),
    "config.hidden": (1, 1024),
    "config.features": (3, 256),
    "config.colour_hidden": (1, 1024),
    "config.occupancy_resolution": (8, 1024),
    "space.scale": (1e-15, _LARGEST),
    "space.half": (1e-9, 1e9),
    "space.near": (0, 1e9),
    "space.far": (1e-9, 1e9),
    "space.step": (1e-6, 1e9),
    "frame.scale": (1e-15, _LARGEST),
    "frame.metres_per_unit": (1e-15, _LARGEST),
    "metres_per_unit": (1e-15, _LARGEST),
    "error_scale": (0, _LARGEST),
    "accuracy.error_scale": (0, _LARGEST),
    "background": (0, 1),
}
"""What numbers of a file may be, those of any build; others are within _LARGEST of zero."""


def checked(metadata: FieldMetadata) -> FieldMetadata:
    """The same, of a field that can be rendered. Raises ValueError for numbers that none can have."""
    for name, value in _numbers(msgspec.to_builtins(metadata), ""):
        least, most = _RANGES.get(name, (-_LARGEST, _LARGEST))
        if not least <= value <= most:
            raise ValueError(f"{name} is {value:g}, expected {least:g} to {most:g}")
    space = metadata.space
    if not space.near < space.far:
        raise ValueError(f"space.near is {space.near:g}, expected less than space.far, {space.far:g}")
    corners = space.corners
    if corners is not None and not (corners[0] < corners[1]).all():
        raise ValueError(f"space.box is {space.box}, expected its lowest and its highest corner")
    for name, rows in (("space.rotation", space.rotation), ("frame.rotation", metadata.frame.rotation)):
        if not is_rigid(from_rotation(np.reshape(np.array(rows), (3, 3))), RIGID_TOLERANCE):
            raise ValueError(f"{name} is no rotation")
    for view in metadata.cameras:
        if len(view.cam_from_object) != 16 or not is_rigid(view.pose, RIGID_TOLERANCE):
            raise ValueError(f"the pose of {view.name!r} is no rigid transform")
        _ = view.camera
    return metadata


def _numbers(value: object, name: str) -> Iterator[tuple[str, float]]:
    """Each number with its place; those of a list have the list's."""
    if isinstance(value, dict):
        for key, part in value.items():
            yield from _numbers(part, f"{name}.{key}" if name else str(key))
    elif isinstance(value, list | tuple):
        for part in value:
            yield from _numbers(part, name)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield name, value
