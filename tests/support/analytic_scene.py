"""A scene of known geometry that renders like a radiance field: textured boxes and spheres, soft silhouettes."""

from __future__ import annotations

import numpy as np
import torch

from fieldpose.stages.geometry import Camera, look_at, rays
from fieldpose.stages.nerf.rendering_api import RenderedRays, RenderedView

SPHERES = (((0.55, 0.1, 0.15), 0.5), ((-0.2, 0.75, -0.25), 0.35))
BOXES = (((-0.95, -0.7, -0.6), (-0.05, 0.3, 0.5)), ((-1.1, -1.1, -0.75), (1.2, 1.2, -0.6)))


class AnalyticScene:
    """A RayRenderer of spheres and boxes with a solid texture; ray by ray, so that autograd gives its Jacobian."""

    def __init__(
        self, seed: int = 0, background: tuple[float, float, float] = (1.0, 1.0, 1.0), softness: float = 0.008
    ) -> None:
        generator = torch.Generator().manual_seed(seed)
        self._octaves = [torch.rand(1, 3, n, n, n, generator=generator, dtype=torch.float64) for n in (14, 40)]
        self._background = torch.tensor(background, dtype=torch.float64)
        self._softness = softness

    def render_rays(self, origins: np.ndarray, directions: np.ndarray) -> RenderedRays:
        with torch.no_grad():
            return _as_rays(*self._composite(_tensor(origins), _tensor(directions)))

    def render_rays_jacobian(
        self, origins: np.ndarray, directions: np.ndarray, channel_weights: np.ndarray
    ) -> tuple[RenderedRays, np.ndarray]:
        origin, direction = _tensor(origins).requires_grad_(), _tensor(directions).requires_grad_()
        rgb, depth, opacity = self._composite(origin, direction)
        channels = rgb @ _tensor(channel_weights).T
        gradients = [
            torch.cat(torch.autograd.grad(channels[:, k].sum(), (origin, direction), retain_graph=True), dim=1)
            for k in range(channels.shape[1])
        ]
        rendered = _as_rays(rgb.detach(), depth.detach(), opacity.detach())
        return rendered, torch.stack(gradients, dim=1).numpy().astype(np.float32)

    def render_view(self, camera: Camera, cam_from_object: np.ndarray) -> RenderedView:
        rendered = self.render_rays(*rays(camera, cam_from_object))
        shape = (camera.height, camera.width)
        rgb = np.clip(np.rint(rendered.rgb * 255), 0, 255).astype(np.uint8).reshape(*shape, 3)
        depth, opacity = rendered.depth.reshape(shape), rendered.opacity.reshape(shape)
        return RenderedView(rgb, depth, opacity, camera, cam_from_object)

    def _composite(
        self, origin: torch.Tensor, direction: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        hits = [_sphere(origin, direction, *sphere, self._softness) for sphere in SPHERES]
        hits += [_box(origin, direction, *box, self._softness) for box in BOXES]
        depths = torch.stack([hit[0] for hit in hits])
        alphas = torch.stack([hit[1] for hit in hits])
        order = torch.argsort(depths.detach(), dim=0)
        depths, alphas = depths.gather(0, order), alphas.gather(0, order)
        through = torch.cat([torch.ones_like(alphas[:1]), torch.cumprod(1 - alphas, dim=0)])
        weights = alphas * through[:-1]
        colours = self._texture(origin[None] + depths[..., None] * direction[None])
        rgb = (weights[..., None] * colours).sum(0) + through[-1][:, None] * self._background
        opacity = weights.sum(0)
        depth = torch.where(opacity > 1e-4, (weights * depths).sum(0) / opacity.clamp_min(1e-4), 0.0)
        return rgb, depth, opacity

    def _texture(self, points: torch.Tensor) -> torch.Tensor:
        grid = (points / 1.6).reshape(1, 1, 1, -1, 3)
        values = [
            torch.nn.functional.grid_sample(volume, grid, align_corners=True, padding_mode="reflection")
            for volume in self._octaves
        ]
        mixed = (0.5 * values[0] + 0.5 * values[1]).reshape(3, -1).T.reshape(points.shape)
        return torch.sigmoid(14 * (mixed - 0.5))


def distance_to_surface(points: np.ndarray) -> np.ndarray:
    """How far points (n, 3) are from the nearest surface of the scene, (n,)."""
    distances = [np.abs(np.linalg.norm(points - centre, axis=1) - radius) for centre, radius in SPHERES]
    for low, high in BOXES:
        middle, half = (np.array(low) + high) / 2, (np.array(high) - low) / 2
        outside = np.abs(points - middle) - half
        across = np.linalg.norm(np.maximum(outside, 0), axis=1)
        distances.append(np.abs(across + np.minimum(outside.max(axis=1), 0)))
    return np.min(distances, axis=0)


def camera(size: int = 200, distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)) -> Camera:
    """A square camera that sees the whole scene from 4 units away."""
    focal, centre = 1.35 * size, (size - 1) / 2
    return Camera(size, size, focal, focal, centre, centre, distortion)


def viewpoint(azimuth_deg: float = 20.0, elevation_deg: float = 35.0, distance: float = 4.0) -> np.ndarray:
    """cam_from_object of a camera that looks at the middle of the scene."""
    azimuth, elevation = np.deg2rad(azimuth_deg), np.deg2rad(elevation_deg)
    across = np.cos(elevation)
    eye = distance * np.array([across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation)])
    return look_at(eye, (0.0, 0.0, -0.1), (0.0, 0.0, 1.0))


def _sphere(
    origin: torch.Tensor, direction: torch.Tensor, centre: tuple[float, ...], radius: float, softness: float
) -> tuple[torch.Tensor, torch.Tensor]:
    to_centre = torch.tensor(centre, dtype=origin.dtype) - origin
    length2 = (direction * direction).sum(1)
    nearest = (to_centre * direction).sum(1) / length2
    miss = torch.linalg.norm(to_centre - nearest[:, None] * direction, dim=1)
    half_chord = torch.sqrt(torch.nn.functional.softplus((radius**2 - miss**2) * 200) / 200 / length2 + 1e-12)
    return nearest - half_chord, torch.sigmoid((radius - miss) / softness) * (nearest > 0)


def _box(
    origin: torch.Tensor, direction: torch.Tensor, low: tuple[float, ...], high: tuple[float, ...], softness: float
) -> tuple[torch.Tensor, torch.Tensor]:
    safe = torch.where(direction.abs() < 1e-9, 1e-9, direction)
    first = (torch.tensor(low, dtype=origin.dtype) - origin) / safe
    second = (torch.tensor(high, dtype=origin.dtype) - origin) / safe
    enter, leave = torch.minimum(first, second).amax(1), torch.maximum(first, second).amin(1)
    chord = (leave - enter) * torch.linalg.norm(direction, dim=1)
    return enter, torch.sigmoid((chord - 4 * softness) / softness) * (enter > 0)


def _tensor(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float64))


def _as_rays(rgb: torch.Tensor, depth: torch.Tensor, opacity: torch.Tensor) -> RenderedRays:
    return RenderedRays(*(values.numpy().astype(np.float32) for values in (rgb, depth, opacity)))
