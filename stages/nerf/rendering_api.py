"""What the stages ask of a radiance field: colours, depths and their derivatives along rays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Float

from fieldpose.stages.geometry.arrays import (
    Colours32,
    Depth,
    Directions32,
    Image,
    Jacobians,
    Opacity,
    Points32,
    Transform,
    Values32,
)
from fieldpose.stages.geometry.cameras import Camera


@dataclass(frozen=True)
class RenderedRays:
    """Rays composited over the field's background.

    rgb and opacity are in 0..1.  depth: the multiple of the ray's direction at which the surface lies (0 where opacity
    is 0); with directions of z = 1 in the camera it is the depth along the optical axis.
    """

    rgb: Colours32
    depth: Values32
    opacity: Values32


@dataclass(frozen=True)
class RenderedView:
    """What a camera sees of a field."""

    rgb: Image
    depth: Depth
    opacity: Opacity
    camera: Camera
    cam_from_object: Transform


class RayRenderer(Protocol):
    """A trained field that can be rendered."""

    def render_rays(self, origins: Points32, directions: Directions32) -> RenderedRays:
        """Render rays in object coordinates; directions keep their length."""
        ...

    def render_rays_jacobian(
        self, origins: Points32, directions: Directions32, channel_weights: Float[np.ndarray, "k 3"]
    ) -> tuple[RenderedRays, Jacobians]:
        """Also return d(channel_weights @ rgb) / d(origin, direction) of each ray."""
        ...

    def render_view(self, camera: Camera, cam_from_object: Transform) -> RenderedView:
        """Render every pixel of an undistorted camera."""
        ...
