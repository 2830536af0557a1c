"""Colour differences between a frame and the field, and their derivative by the pose.

The loss of a difference r is c^2 r^2 / (c^2 + r^2) / 2, which what hides the object cannot raise beyond c^2 / 2.
Source: Geman and McClure, Statistical methods for tomographic image reconstruction (1987).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float

from fieldpose.stages.geometry import Camera, image_jacobian, twist_covariance, twist_gradient
from fieldpose.stages.geometry.arrays import (
    Covariance,
    Directions32,
    Image,
    Jacobians,
    Mask,
    Matrix6,
    Pixels,
    Points32,
    Transform,
    Twist,
    Values,
    Values32,
)
from fieldpose.stages.nerf.rendering_api import RayRenderer, RenderedRays
from fieldpose.stages.refinement import constants
from fieldpose.stages.refinement.config import RefinementConfig

_SCHARR_SUM = 32
_SHARPNESS = 8
"""Silhouettes pull by what lies behind them; a power of the opacity takes even thinly mixed pixels out."""
_GREY = np.array([[0.299, 0.587, 0.114]], np.float32)


@dataclass(frozen=True)
class PixelSample:
    """Pixels of a frame: directions in the camera, z = 1; colours in 0..1.

    slopes: derivatives of the colours by the direction's x and y.
    """

    directions: Directions32
    colours: Float[np.ndarray, "n k"]
    slopes: Float[np.ndarray, "n k 2"]
    weights: Values

    def part(self, chosen: np.ndarray | slice) -> PixelSample:
        """Some of the pixels."""
        values = (self.directions, self.colours, self.slopes, self.weights)
        return PixelSample(*(value[chosen] for value in values))


@dataclass(frozen=True)
class Linearised:
    """loss at a pose, and Gauss-Newton's gradient and Hessian of it by the left twist."""

    loss: float
    gradient: Twist
    hessian: Matrix6


class Photometric:
    """The loss of the differences between samples of a frame and the field rendered at a pose."""

    def __init__(self, renderer: RayRenderer, config: RefinementConfig) -> None:
        self._renderer, self._scale2 = renderer, config.outlier**2
        self._through_field, self._blur_px = config.derivative == "field", constants.BLUR_PX
        self._channels = np.eye(3, dtype=np.float32) if config.colours == "rgb" else _GREY

    def sample(self, image: Image, camera: Camera, pixels: Pixels) -> PixelSample:
        """The colours of whole pixels of an image; all count the same."""
        x, y = pixels.astype(int).T
        values = (image.astype(np.float32) / 255 @ self._channels.T).reshape(*image.shape[:2], -1)
        smooth = cv2.GaussianBlur(values, (0, 0), self._blur_px) if self._blur_px > 0 else values
        across = cv2.Scharr(smooth, cv2.CV_32F, 1, 0).reshape(values.shape)[y, x] * (camera.fx / _SCHARR_SUM)
        down = cv2.Scharr(smooth, cv2.CV_32F, 0, 1).reshape(values.shape)[y, x] * (camera.fy / _SCHARR_SUM)
        ones = np.ones(len(pixels), np.float32)
        return PixelSample(camera.directions(pixels), values[y, x], np.stack([across, down], axis=2), ones)

    def weighted_by_opacity(self, sample: PixelSample, cam_from_object: Transform) -> tuple[PixelSample, float]:
        """The sample with weights that tell surface from background at a pose, and the median depth (0: no hit)."""
        rendered = self._renderer.render_rays(*_rays(sample, cam_from_object))
        hit = rendered.depth[rendered.opacity > 0.5]
        return replace(sample, weights=rendered.opacity**_SHARPNESS), float(np.median(hit)) if len(hit) else 0.0

    def loss(self, sample: PixelSample, cam_from_object: Transform) -> float:
        """The weighted mean loss at a pose."""
        rendered = self._renderer.render_rays(*_rays(sample, cam_from_object))
        return self._mean(*self._compare(sample, rendered))

    def linearise(self, sample: PixelSample, cam_from_object: Transform) -> Linearised:
        """The loss at a pose and its derivatives by the left twist."""
        rendered, jacobian = self._render(sample, cam_from_object)
        residuals, weights = self._compare(sample, rendered)
        pull = weights * (self._scale2 / (self._scale2 + residuals**2)) ** 2 / max(weights.sum(), 1e-12)
        flat = jacobian.reshape(-1, 6).astype(np.float64)
        pulled = pull.reshape(-1, 1) * flat
        return Linearised(self._mean(residuals, weights), pulled.T @ residuals.ravel(), pulled.T @ flat)

    def covariance(self, sample: PixelSample, cam_from_object: Transform, camera: Camera, shared: float) -> Covariance:
        """Covariance of a pose that pixels like these were fitted by; see twist_covariance.

        shared: how far neighbouring pixels err together, as a multiple of a typical residual.
        """
        rendered, jacobian = self._render(sample, cam_from_object)
        residuals, weights = self._compare(sample, rendered)
        pull = weights[:, 0] * ((self._scale2 / (self._scale2 + residuals**2)) ** 2).mean(axis=1)
        variance = (pull[:, None] * residuals**2).sum() / max(pull.sum() * residuals.shape[1], 1e-12)
        pixels = camera.project(sample.directions)
        longer_side = max(camera.width, camera.height)
        typical = max(float((pull**2).sum() / max(pull.sum(), 1e-12)), 1e-12)
        return twist_covariance(
            jacobian.astype(np.float64), pull[:, None, None] * np.eye(residuals.shape[1]), pixels, longer_side,
            float(variance), shared**2 * float(variance) / typical,
        )  # fmt: skip

    def _render(self, sample: PixelSample, cam_from_object: Transform) -> tuple[RenderedRays, Jacobians]:
        """Colours at a pose and their derivative by the left twist."""
        origins, directions = _rays(sample, cam_from_object)
        if self._through_field:
            rendered, by_ray = self._renderer.render_rays_jacobian(origins, directions, self._channels)
            return rendered, _through_rays(by_ray, sample.directions, cam_from_object)
        rendered = self._renderer.render_rays(origins, directions)
        return rendered, _along_motion(sample, rendered.depth)

    def _compare(self, sample: PixelSample, rendered: RenderedRays) -> tuple[np.ndarray, np.ndarray]:
        residuals = (rendered.rgb @ self._channels.T - sample.colours).astype(np.float64)
        return residuals, np.broadcast_to(sample.weights[:, None], residuals.shape).astype(np.float64)

    def _mean(self, residuals: np.ndarray, weights: np.ndarray) -> float:
        squared = residuals**2
        loss = self._scale2 * squared / (self._scale2 + squared) / 2
        return float((weights * loss).sum() / max(weights.sum(), 1e-12))


def keypoint_region(keypoints: Pixels, camera: Camera, dilations: int) -> Mask:
    """Mask of the keypoints, dilated `dilations` times by 5 x 5 pixels."""
    mask = np.zeros((camera.height, camera.width), np.uint8)
    x, y = np.rint(keypoints).astype(int).T
    inside = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    mask[y[inside], x[inside]] = 1
    return cv2.dilate(mask, np.ones((5, 5), np.uint8), iterations=dilations).astype(bool) if dilations else mask > 0


def _rays(sample: PixelSample, cam_from_object: Transform) -> tuple[Points32, Directions32]:
    rotation = cam_from_object[:3, :3]
    origin = (-rotation.T @ cam_from_object[:3, 3]).astype(np.float32)
    directions = sample.directions @ rotation.astype(np.float32)
    return np.repeat(origin[None], len(directions), axis=0), directions


def _through_rays(by_ray: Jacobians, directions: Directions32, cam_from_object: Transform) -> Jacobians:
    """From derivatives by origin and direction in the object to those by the left twist.

    In the camera's axes all rays start at 0, and the object moving by a twist is the rays moving by its negative.
    """
    object_to_cam = cam_from_object[:3, :3].T.astype(np.float32)
    in_cam = np.concatenate([by_ray[..., :3] @ object_to_cam, by_ray[..., 3:] @ object_to_cam], axis=-1)
    return -twist_gradient(np.zeros(3, np.float32), directions[:, None], in_cam)


def _along_motion(sample: PixelSample, depth: Values32) -> Jacobians:
    """Derivatives of rendered colours by the left twist, from the frame's slopes; 0 where nothing is hit.

    A surface point that a twist moves to the right brings the colour from its left; where frame and render agree,
    that is the frame's. Source: Lucas and Kanade (1981); Engel et al., Direct sparse odometry (2018), for the pose.
    """
    u, v = sample.directions[:, 0], sample.directions[:, 1]
    inverse = np.where(depth > 0, 1 / np.maximum(depth, 1e-6), 0)
    motion = image_jacobian(u, v, inverse) * (depth > 0)[:, None, None]
    return -sample.slopes @ motion
