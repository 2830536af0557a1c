"""What the stages ask of a radiance field: colours, depths and their derivatives along rays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from fieldpose.stages.geometry.cameras import Camera


@dataclass(frozen=True)
class RenderedRays:
    """Rays composited over the field's background.

    rgb: (n, 3) float32 in 0..1.  depth: (n,) float32, the multiple of the ray's direction at which the surface lies
    (0 where opacity is 0); with directions of z = 1 in the camera it is the depth along the optical axis.
    opacity: (n,) float32 in 0..1.
    """

    rgb: np.ndarray
    depth: np.ndarray
    opacity: np.ndarray


@dataclass(frozen=True)
class RenderedView:
    """rgb (h, w, 3) uint8, depth (h, w) float32 along the optical axis, opacity (h, w) float32 in 0..1."""

    rgb: np.ndarray
    depth: np.ndarray
    opacity: np.ndarray
    camera: Camera
    cam_from_object: np.ndarray


class RayRenderer(Protocol):
    """A trained field that can be rendered."""

    def render_rays(self, origins: np.ndarray, directions: np.ndarray) -> RenderedRays:
        """Render (n, 3) float32 rays in object coordinates; directions keep their length."""
        ...

    def render_rays_jacobian(
        self, origins: np.ndarray, directions: np.ndarray, channel_weights: np.ndarray
    ) -> tuple[RenderedRays, np.ndarray]:
        """Also return (n, k, 6): d(channel_weights (k, 3) @ rgb) / d(origin, direction) of each ray."""
        ...

    def render_view(self, camera: Camera, cam_from_object: np.ndarray) -> RenderedView:
        """Render every pixel of an undistorted camera."""
        ...
