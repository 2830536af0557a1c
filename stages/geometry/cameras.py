"""Pinhole cameras with OpenCV's distortion, and the rays through their pixels.

Axes are OpenCV's (x right, y down, z forward); pixel (0, 0) is the centre of the top-left pixel.
"""

from __future__ import annotations

from typing import TypeVar

import msgspec
import numpy as np

from fieldpose.errors import GeometryError
from fieldpose.stages.geometry.arrays import (
    Directions32,
    Flags,
    Matrices2,
    Matrix3,
    Normalised,
    Pixels,
    Pixels32,
    Pixels64,
    Points,
    Points32,
    Transform,
    Values,
)

LARGEST_SIDE = 16384
_UNDISTORTED = (0.0, 0.0, 0.0, 0.0, 0.0)
_NEWTON_STEPS = 25
_INVERSE_TOLERANCE_PX = 1e-4
_Pixels = TypeVar("_Pixels", float, np.ndarray)


class Camera(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Intrinsics in pixels; distortion is OpenCV's k1 k2 p1 p2 k3. GeometryError if they make no camera.

    It is also the camera of messages and of files.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = _UNDISTORTED

    def __post_init__(self) -> None:
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        if len(self.distortion) != 5 or not np.all(np.isfinite(numbers)):
            raise GeometryError(f"a camera needs finite intrinsics and five distortion coefficients, got {self}")
        if not (1 <= self.width <= LARGEST_SIDE and 1 <= self.height <= LARGEST_SIDE and self.fx > 0 and self.fy > 0):
            raise GeometryError(f"a camera needs a size of 1 to {LARGEST_SIDE} and positive focal lengths, got {self}")

    def matrix(self) -> Matrix3:
        """The intrinsic matrix, distortion left out."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def resized(self, width: int, height: int) -> Camera:
        """The camera of this image resized to (width, height); a pixel's area is scaled, not its centre."""
        sx, sy = width / self.width, height / self.height
        cx, cy = scale_pixels(self.cx, sx), scale_pixels(self.cy, sy)
        return msgspec.structs.replace(self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=cx, cy=cy)

    def shrunk(self, longer_side: int) -> Camera:
        """resized() to shrunk_size(); the camera itself where its image is no larger."""
        size = shrunk_size(self.width, self.height, longer_side)
        return self if size == (self.width, self.height) else self.resized(*size)

    def undistorted(self) -> Camera:
        """The same camera without distortion."""
        return msgspec.structs.replace(self, distortion=_UNDISTORTED)

    @property
    def is_distorted(self) -> bool:
        """Whether any distortion coefficient differs from zero."""
        return any(self.distortion)

    def grid(self) -> Pixels32:
        """Every pixel, row by row."""
        x, y = np.meshgrid(np.arange(self.width, dtype=np.float32), np.arange(self.height, dtype=np.float32))
        return np.stack([x.ravel(), y.ravel()], axis=1)

    def directions(self, pixels: Pixels) -> Directions32:
        """Directions in the camera frame with z = 1 through pixels, distortion removed.

        GeometryError where the distortion has no inverse (it folds the image over itself at that pixel).
        """
        ideal, usable = self._ideal(pixels)
        if not usable.all():
            worst = np.asarray(pixels)[np.argmin(usable)]
            raise GeometryError(
                f"the distortion {self.distortion} has no inverse at pixel ({worst[0]:.1f}, {worst[1]:.1f});"
                " recalibrate the camera or crop the image to where the model is valid"
            )
        return np.concatenate([ideal, np.ones((len(ideal), 1))], axis=1).astype(np.float32)

    def without_distortion(self, pixels: Pixels) -> tuple[Pixels64, Flags]:
        """Where pixels are in the image of the undistorted camera, and which are at all.

        Those are not where the distortion has no inverse.
        """
        ideal, usable = self._ideal(pixels)
        return ideal * (self.fx, self.fy) + (self.cx, self.cy), usable

    def project(self, points_in_cam: Points) -> Pixels64:
        """Pixels, with distortion, of points in the camera frame; NaN where z <= 0."""
        points = np.asarray(points_in_cam, dtype=np.float64)
        z = np.where(points[:, 2:] > 0, points[:, 2:], np.nan)
        ideal = points[:, :2] / z
        if self.is_distorted:
            ideal = distort(ideal, self.distortion)[0]
        return ideal * (self.fx, self.fy) + (self.cx, self.cy)

    def _ideal(self, pixels: Pixels) -> tuple[Normalised, Flags]:
        """Pixels as normalised image points, and whether these were found, by Newton's method.

        Solutions where the derivative is not positive lie beyond the fold of the image and are none.
        """
        distorted = (np.asarray(pixels, dtype=np.float64) - (self.cx, self.cy)) / (self.fx, self.fy)
        if not self.is_distorted:
            return distorted, np.ones(len(distorted), bool)
        ideal = distorted.copy()
        tolerance = _INVERSE_TOLERANCE_PX / max(self.fx, self.fy)
        for _ in range(_NEWTON_STEPS):
            predicted, jacobian = distort(ideal, self.distortion)
            residual = predicted - distorted
            determinant = jacobian[:, 0, 0] * jacobian[:, 1, 1] - jacobian[:, 0, 1] * jacobian[:, 1, 0]
            folded = (determinant <= 0) | (jacobian[:, 0, 0] + jacobian[:, 1, 1] <= 0)
            usable = ~folded & (np.abs(residual) < tolerance).all(axis=1)
            if usable.all():
                break
            ideal -= _solve_2x2(jacobian, determinant, residual)
        return ideal, usable


def shrunk_size(width: int, height: int, longer_side: int) -> tuple[int, int]:
    """Width and height, the longer at most `longer_side`, to the nearest whole numbers and never 0."""
    factor = min(1.0, longer_side / max(width, height))
    return max(1, round(width * factor)), max(1, round(height * factor))


def scale_pixels(pixels: _Pixels, scale: _Pixels) -> _Pixels:
    """Where pixels are once their image is resized; scale: new size / old size. Both along one axis, or (..., 2)."""
    return (pixels + 0.5) * scale - 0.5


def unscale_pixels(pixels: _Pixels, scale: _Pixels) -> _Pixels:
    """Where pixels of the resized image were before: the inverse of scale_pixels."""
    return (pixels + 0.5) / scale - 0.5


def distort(ideal: Normalised, distortion: tuple[float, ...]) -> tuple[Normalised, Matrices2]:
    """Distorted image points of ideal ones, and the derivative by them.

    Source: Brown, Decentering distortion of lenses (1966), in OpenCV's order k1 k2 p1 p2 k3.
    """
    k1, k2, p1, p2, k3 = distortion
    x, y = ideal[:, 0], ideal[:, 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))
    distorted = np.empty_like(ideal)
    distorted[:, 0] = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    distorted[:, 1] = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    jacobian = np.empty((len(ideal), 2, 2))
    jacobian[:, 0, 0] = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
    jacobian[:, 1, 1] = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
    jacobian[:, 0, 1] = jacobian[:, 1, 0] = x * y * slope + 2 * p1 * x + 2 * p2 * y
    return distorted, jacobian


def rays(camera: Camera, cam_from_object: Transform, pixels: Pixels | None = None) -> tuple[Points32, Directions32]:
    """Origins and directions in object coordinates, through pixels or all of grid().

    Directions have length 1 along the optical axis: ``origin + depth * direction`` is the point at that depth.
    """
    in_cam = camera.directions(camera.grid() if pixels is None else pixels)
    object_from_cam_rotation = cam_from_object[:3, :3].T
    directions = (in_cam @ object_from_cam_rotation.T).astype(np.float32)
    origin = (-object_from_cam_rotation @ cam_from_object[:3, 3]).astype(np.float32)
    return np.repeat(origin[None], len(directions), axis=0), directions


def points_at_depth(camera: Camera, cam_from_object: Transform, pixels: Pixels, depths: Values) -> Points:
    """Points in object coordinates that are seen at pixels, at depths along the axis."""
    origins, directions = rays(camera, cam_from_object, pixels)
    points: np.ndarray = origins + depths[:, None] * directions
    return points


def _solve_2x2(matrix: np.ndarray, determinant: np.ndarray, right: np.ndarray) -> np.ndarray:
    safe = np.where(np.abs(determinant) > 1e-6, determinant, 1e-6)
    x = (matrix[:, 1, 1] * right[:, 0] - matrix[:, 0, 1] * right[:, 1]) / safe
    y = (matrix[:, 0, 0] * right[:, 1] - matrix[:, 1, 0] * right[:, 0]) / safe
    return np.stack([x, y], axis=1)
