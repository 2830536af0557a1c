"""The pose that fits correspondences best once the wrong ones are gone."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit

from fieldpose.stages.geometry import Camera, image_jacobian
from fieldpose.stages.kernel_cache import cached_njit

_MAX_STEPS = 20
CONVERGED = 1e-5
_HUBER = 1.345
_MEDIAN_TO_SIGMA = 1.1774
"""The median length of a 2-D Gaussian of unit sigma is this; Huber's constant is for a known sigma."""


@dataclass(frozen=True)
class PoseFit:
    """cam_from_object (4, 4), and what it was fitted to: pixels (n, 2), points (n, 3), camera, weights (n, 2, 2)."""

    cam_from_object: np.ndarray
    pixels: np.ndarray
    points: np.ndarray
    camera: Camera
    weights: np.ndarray

    @cached_property
    def errors(self) -> tuple[np.ndarray, np.ndarray]:
        """The residuals (n, 2) in pixels and their derivatives (n, 2, 6), as `reprojection` has them."""
        return reprojection(self.pixels, self.points, self.camera, self.cam_from_object)

    @property
    def variance(self) -> float:
        """Of a residual of weight 1."""
        residuals = self.errors[0]
        return _huber_variance(np.sqrt(np.einsum("ni,nij,nj->n", residuals, self.weights, residuals)))

    @property
    def variance_px(self) -> float:
        """Of a typical residual, in pixels."""
        return _huber_variance(np.linalg.norm(self.errors[0], axis=1))


def _huber_variance(lengths: np.ndarray) -> float:
    """Of residuals of these lengths (n,) as Huber's loss sees them; Huber, Robust Statistics (1981), section 7.6."""
    delta = huber_delta(lengths)
    freedom = max(2 * len(lengths) - 6, 1)
    slope = np.where(lengths <= delta, 1.0, delta / (2 * np.maximum(lengths, 1e-12))).mean()
    return float((np.minimum(lengths, delta) ** 2).sum() / freedom / slope**2)


def fit_pose(
    pixels: np.ndarray,
    points: np.ndarray,
    camera: Camera,
    cam_from_object: np.ndarray,
    weights: np.ndarray,
    converged: float = CONVERGED,
) -> PoseFit:
    """Minimise Huber's loss of the reprojection errors by Levenberg-Marquardt, from a pose near the minimum.

    pixels (n, 2) of an undistorted camera, points (n, 3) in object coordinates, weights (n, 2, 2), inverse covariances
    of the pixels up to a factor; converged: the length of a twist, in radians and shares of the points' distance, that
    is the last step.
    """
    pixels, points, weights = (np.ascontiguousarray(given, np.float64) for given in (pixels, points, weights))
    distance = np.linalg.norm(np.median(points, axis=0) @ cam_from_object[:3, :3].T + cam_from_object[:3, 3])
    pose = np.array(cam_from_object, np.float64)
    levenberg_marquardt(pixels, points, intrinsics_of(camera), weights, max(float(distance), 1e-12), converged, pose)
    return PoseFit(pose, pixels, points, camera, weights)


def reprojection_errors_px(
    pixels: np.ndarray, points: np.ndarray, camera: Camera, cam_from_object: np.ndarray
) -> np.ndarray:
    """Lengths (n,) of the reprojection errors; infinite behind the camera. Arrays as for fit_pose."""
    lengths, plain = np.empty(len(points)), isotropic(np.ones(len(points)))
    pose = np.ascontiguousarray(cam_from_object, np.float64)
    weighted_lengths(pixels, points, intrinsics_of(camera), pose, plain, lengths)
    return lengths


def isotropic(weights: np.ndarray) -> np.ndarray:
    """Weights (n,) as (n, 2, 2)."""
    matrices: np.ndarray = weights[:, None, None] * np.eye(2)
    return matrices


def intrinsics_of(camera: Camera) -> np.ndarray:
    """fx, fy, cx and cy."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy])


@njit(inline="always")
def project_normalised(pose: np.ndarray, point: np.ndarray) -> tuple[float, float, float]:
    """Where a point is in an image of focal length 1, and its depth; where that is not positive, it alone counts."""
    p0, p1, p2 = point
    z = pose[2, 0] * p0 + pose[2, 1] * p1 + pose[2, 2] * p2 + pose[2, 3]
    inverse = 1 / z if z > 0 else 0.0
    u = (pose[0, 0] * p0 + pose[0, 1] * p1 + pose[0, 2] * p2 + pose[0, 3]) * inverse
    v = (pose[1, 0] * p0 + pose[1, 1] * p1 + pose[1, 2] * p2 + pose[1, 3]) * inverse
    return u, v, z


@cached_njit(nogil=True)
def weighted_lengths(
    pixels: np.ndarray, points: np.ndarray, intrinsics: np.ndarray, pose: np.ndarray, weights: np.ndarray,
    out: np.ndarray,
) -> None:  # fmt: skip
    """Lengths out (n,) of reprojection errors by their weights (n, 2, 2); infinite behind the camera. All float64."""
    fx, fy, cx, cy = intrinsics
    for i in range(points.shape[0]):
        u, v, z = project_normalised(pose, points[i])
        if z <= 0:
            out[i] = np.inf
            continue
        x, y = fx * u + cx - pixels[i, 0], fy * v + cy - pixels[i, 1]
        out[i] = math.sqrt(weights[i, 0, 0] * x * x + 2 * weights[i, 0, 1] * x * y + weights[i, 1, 1] * y * y)


@cached_njit(nogil=True)
def normal_equations(
    pixels: np.ndarray, points: np.ndarray, intrinsics: np.ndarray, pose: np.ndarray, weights: np.ndarray,
    delta: float, gradient: np.ndarray, hessian: np.ndarray,
) -> None:  # fmt: skip
    """Fill the gradient (6,) and Gauss-Newton's Hessian (6, 6) of Huber's loss by the left twist of a pose (4, 4).

    `reprojection` has the residuals and derivatives; points behind the camera count for nothing.
    """
    fx, fy, cx, cy = intrinsics
    gradient[:] = 0
    hessian[:] = 0
    rows = np.empty((2, 6))
    for i in range(points.shape[0]):
        u, v, z = project_normalised(pose, points[i])
        if z <= 0:
            continue
        x, y = fx * u + cx - pixels[i, 0], fy * v + cy - pixels[i, 1]
        xx, xy, yy = weights[i, 0, 0], weights[i, 0, 1], weights[i, 1, 1]
        length = math.sqrt(xx * x * x + 2 * xy * x * y + yy * y * y)
        robust = 1.0 if length <= delta else delta / length
        xx, xy, yy = robust * xx, robust * xy, robust * yy
        rows[0, 0], rows[0, 1], rows[0, 2] = fx / z, 0.0, -fx * u / z
        rows[0, 3], rows[0, 4], rows[0, 5] = -fx * u * v, fx * (1 + u * u), -fx * v
        rows[1, 0], rows[1, 1], rows[1, 2] = 0.0, fy / z, -fy * v / z
        rows[1, 3], rows[1, 4], rows[1, 5] = -fy * (1 + v * v), fy * u * v, fy * u
        for a in range(6):
            across, down = xx * rows[0, a] + xy * rows[1, a], xy * rows[0, a] + yy * rows[1, a]
            gradient[a] += across * x + down * y
            for b in range(a + 1):
                hessian[a, b] += across * rows[0, b] + down * rows[1, b]
    for a in range(6):
        for b in range(a):
            hessian[b, a] = hessian[a, b]


@njit(nogil=True)
def order_statistic(values: np.ndarray, k: int) -> float:
    """np.partition(values, k)[k] (Hoare's quickselect), which takes numba seconds less to compile."""
    a = values.copy()
    low, high = 0, a.shape[0] - 1
    while low < high:
        pivot, i, j = a[(low + high) // 2], low, high
        while i <= j:
            while a[i] < pivot:
                i += 1
            while pivot < a[j]:
                j -= 1
            if i <= j:
                a[i], a[j] = a[j], a[i]
                i, j = i + 1, j - 1
        if k <= j:
            high = j
        elif k >= i:
            low = i
        else:
            break
    return a[k]


@cached_njit(nogil=True)
def huber_delta(lengths: np.ndarray) -> float:
    """Up to which length of weighted residuals (n,) Huber's loss is quadratic."""
    return max(_HUBER * order_statistic(lengths, lengths.shape[0] // 2) / _MEDIAN_TO_SIGMA, 1e-6)


@njit(nogil=True)
def huber_cost(lengths: np.ndarray, delta: float) -> float:
    """Sum over weighted residuals (n,)."""
    total = 0.0
    for length in lengths:
        total += length * length if length <= delta else delta * (2 * length - delta)
    return total


@njit(nogil=True)
def exp_se3_times(step: np.ndarray, pose: np.ndarray, out: np.ndarray) -> None:
    """exp(step) @ pose (4, 4) into out, for a twist (6,); `exp_se3` is its plain twin."""
    w0, w1, w2 = step[3], step[4], step[5]
    squared = w0 * w0 + w1 * w1 + w2 * w2
    angle = math.sqrt(squared)
    if angle < 1e-3:
        a, b, c = 1 - squared / 6, 0.5 - squared / 24, 1 / 6 - squared / 120
    else:
        a = math.sin(angle) / angle
        b, c = 2 * math.sin(angle / 2) ** 2 / squared, (1 - a) / squared
    cross = np.array([[0.0, -w2, w1], [w2, 0.0, -w0], [-w1, w0, 0.0]])
    for i in range(3):
        for j in range(4):
            out[i, j] = pose[i, j]
            for k in range(3):
                twice = cross[i, 0] * cross[0, k] + cross[i, 1] * cross[1, k] + cross[i, 2] * cross[2, k]
                out[i, j] += (a * cross[i, k] + b * twice) * pose[k, j]
                if j == 3:
                    out[i, j] += ((1.0 if i == k else 0.0) + b * cross[i, k] + c * twice) * step[k]
    out[3] = pose[3]


@cached_njit(nogil=True)
def levenberg_marquardt(
    pixels: np.ndarray, points: np.ndarray, intrinsics: np.ndarray, weights: np.ndarray, distance: float,
    converged: float, pose: np.ndarray,
) -> None:  # fmt: skip
    """Move a pose (4, 4) to the nearest minimum of Huber's loss by Levenberg-Marquardt. All float64."""
    lengths, moved_lengths = np.empty(points.shape[0]), np.empty(points.shape[0])
    gradient, hessian, moved = np.empty(6), np.empty((6, 6)), np.empty((4, 4))
    damping = 1e-6
    weighted_lengths(pixels, points, intrinsics, pose, weights, lengths)
    for _ in range(_MAX_STEPS):
        delta = huber_delta(lengths)
        normal_equations(pixels, points, intrinsics, pose, weights, delta, gradient, hessian)
        for i in range(6):
            hessian[i, i] = hessian[i, i] * (1 + damping) + 1e-12
        step = -np.linalg.solve(hessian, gradient)
        exp_se3_times(step, pose, moved)
        weighted_lengths(pixels, points, intrinsics, moved, weights, moved_lengths)
        if huber_cost(moved_lengths, delta) <= huber_cost(lengths, delta):
            pose[:] = moved
            lengths[:] = moved_lengths
            damping /= 10
        else:
            damping *= 100
        step[:3] /= distance
        if np.linalg.norm(step) < converged:
            break


def reprojection(
    pixels: np.ndarray, points: np.ndarray, camera: Camera, cam_from_object: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (n, 2) in pixels and their derivative (n, 2, 6) by the left twist; infinite behind the camera."""
    in_cam = points @ cam_from_object[:3, :3].T + cam_from_object[:3, 3]
    x, y, z = in_cam.T
    inverse = 1 / np.where(z > 1e-9, z, 1e-9)
    u, v = x * inverse, y * inverse
    jacobian = image_jacobian(u, v, inverse) * np.array([camera.fx, camera.fy])[:, None]
    residuals = np.stack([camera.fx * u + camera.cx, camera.fy * v + camera.cy], axis=1) - pixels
    residuals[z <= 0] = np.inf
    return residuals, jacobian
