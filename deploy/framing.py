"""A frame and a unit for a field: from what a user says of points, directions and lengths in it."""

from __future__ import annotations

import msgspec
import numpy as np

from fieldpose.errors import ConfigError, UsageError
from fieldpose.stages.geometry import Similarity, nearest_point_to_axes
from fieldpose.stages.geometry.arrays import Vector
from fieldpose.stages.nerf.datasets.bounds import too_coarse
from fieldpose.stages.nerf.framing import METRE, OWN_UNIT, in_dataset_frame, reframed, shown_at, texture_at
from fieldpose.stages.nerf.metadata import FieldMetadata
from fieldpose.stages.nerf.rendering_api import RayRenderer
from fieldpose.stages.nerf.surface.samples import sampled_surface

_SANE = 1e-9, 1e9
PLAIN = 7.0
"""Grey values that pixels differ by: on a can 12 to 36, on the plain floor around it, learnt far too low, 2 to 6."""
PLANE = "plane"
"""In place of a direction or a point: that of what the object stands on."""


class Framing:
    """Turns, moves and scales a field, one after the other; what is said of it is said in the frame that it had."""

    def __init__(self, renderer: RayRenderer, metadata: FieldMetadata) -> None:
        self._renderer, self.metadata = renderer, metadata
        self._given = metadata
        self.notes: list[str] = []
        self._change = Similarity.identity()
        self._plane: tuple[Vector, float] | None = None

    def point(self, spot: str) -> Vector:
        """A point (3,) in the frame as it was: "X,Y,Z", or "IMAGE:X,Y", what a training view shows at a pixel there.

        Raises UsageError, DatasetError and ConfigError.
        """
        name, colon, pixel = spot.rpartition(":")
        if not colon:
            return np.array(numbers(spot, 3, "a point X,Y,Z, or IMAGE:X,Y"))
        x, y = numbers(pixel, 2, "a pixel X,Y after the image's name")
        point = shown_at(self._renderer, self._given, name, x, y)
        if texture_at(self._renderer, self._given, name, x, y) < PLAIN:
            self.notes.append(f"{spot} is on a surface with little texture, of which a field may not know where it is")
        return point

    def turn(self, up: str) -> None:
        """z becomes `up`, "X,Y,Z" or PLANE; x stays as near to where it was as it can."""
        if up == PLANE:
            normal = self.plane()[0]
        else:
            normal = np.array(numbers(up, 3, f"a direction X,Y,Z, or {PLANE}"))
            if not np.linalg.norm(normal) > 0:
                raise UsageError(f"--up {up}: is no direction; one of X, Y, Z must not be 0")
            normal = normal / np.linalg.norm(normal)
        self._then(Similarity(1.0, _upright(self._change.rotation @ normal), np.zeros(3)))

    def move(self, origin: str) -> None:
        """The origin becomes a point, or with PLANE the one on it under what the cameras look at."""
        if origin == PLANE:
            normal, offset = self.plane()
            focus = nearest_point_to_axes([camera.pose for camera in self._given.cameras])
            point = focus - (normal @ focus - offset) * normal
        else:
            point = self.point(origin)
        self._then(Similarity(1.0, np.eye(3), -self._change.of_points(point[None])[0]))

    def scale(self, factor: float) -> None:
        """Lengths become so many times as large."""
        self._then(Similarity(factor, np.eye(3), np.zeros(3)))
        self._call(METRE if self.metadata.metres_per_unit == 1 else OWN_UNIT)

    def measure(self, first: str, second: str, metres: float) -> float:
        """Between two points are so many metres, in which lengths are from now on; returns the distance as it was."""
        apart = float(np.linalg.norm(self.point(first) - self.point(second)))
        if not apart > 0:
            raise UsageError(f"{first} and {second} are the same point; give two that are apart")
        self.scale(metres / apart)
        self.metadata = msgspec.structs.replace(self.metadata, metres_per_unit=1.0, unit=METRE)
        return apart

    def say_metres(self, metres_per_unit: float) -> None:
        """The unit is known to be so long; no number changes."""
        self._then(Similarity.identity())
        frame = self.metadata.frame
        self.metadata = msgspec.structs.replace(self.metadata, metres_per_unit=metres_per_unit)
        self._call(METRE if metres_per_unit == 1 else OWN_UNIT if frame.scale != 1 else frame.unit or OWN_UNIT)

    def back(self) -> None:
        """The dataset's own frame and unit again, and what it says of the unit's length."""
        self.metadata = in_dataset_frame(self.metadata)

    def check(self) -> None:
        """Raise UsageError for a frame or a unit in which positions are too coarse, or lengths no sound numbers."""
        low, high = _SANE
        scale, metres = self.metadata.frame.scale, self.metadata.metres_per_unit or 1.0
        if not (low < scale < high and low < metres < high):
            raise UsageError(
                f"lengths would be {scale:.3g} times the dataset's, and the unit {metres:.3g} m long; expected both"
                f" from {low:g} to {high:g}"
            )
        if self.metadata.cameras:
            coarse = too_coarse(np.stack([camera.pose for camera in self.metadata.cameras]))
            if coarse is not None:
                raise UsageError(f"{coarse}; choose an origin nearer to the object")

    def plane(self) -> tuple[Vector, float]:
        """Normal n and offset d, n @ x = d, of what the object stands on, in the frame as it was. ConfigError."""
        from fieldpose.stages.structure.upright import plane_under

        if self._plane is None and not self._given.cameras:
            raise ConfigError(f"the field does not tell its training views, from which the {PLANE} would be seen")
        if self._plane is None:
            poses = np.stack([camera.pose for camera in self._given.cameras])
            self._plane = plane_under(poses, sampled_surface(self._renderer, self._given).points)
        if self._plane is None:
            raise ConfigError(
                "no plane was found under the object that most of what is around it lies on; give --up X,Y,Z and"
                " --origin IMAGE:X,Y instead"
            )
        return self._plane

    def _call(self, unit: str) -> None:
        self.metadata = msgspec.structs.replace(self.metadata, unit=unit)

    def _then(self, change: Similarity) -> None:
        self.metadata = reframed(self.metadata, change)
        self._change = change.after(self._change)


def numbers(text: str, count: int, expected: str) -> list[float]:
    """So many finite numbers between commas. UsageError, with what was expected."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not np.isfinite(values).all():
        raise UsageError(f"{text!r}: expected {expected}")
    return values


def _upright(up: Vector) -> np.ndarray:
    """Rotation (3, 3) whose rows are the new axes: z is `up`, x near the old one."""
    old = np.eye(3)[0 if abs(up[0]) < 0.9 else 1]
    x = old - (old @ up) * up
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])
