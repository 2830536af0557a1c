"""Render a field with torch: the slow oracle on the CPU, the fast path on CUDA."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from fieldpose.errors import ConfigError
from fieldpose.stages.geometry import Camera, rays
from fieldpose.stages.nerf.config import Backend
from fieldpose.stages.nerf.field import Field
from fieldpose.stages.nerf.normalise import by_object_rays, normalised
from fieldpose.stages.nerf.rendering_api import RenderedRays, RenderedView
from fieldpose.stages.nerf.twin import TwinField, TwinRays, twin_of

CHUNK = 4096


class TorchRenderer:
    """Implements RayRenderer; evaluates every occupied sample of a ray."""

    def __init__(self, field: Field, device: torch.device | str = "cpu"):
        self.metadata = field.metadata
        self._twin: TwinField = twin_of(field, device)

    def render_rays(self, origins: np.ndarray, directions: np.ndarray) -> RenderedRays:
        """See RayRenderer."""
        o, d, length = normalised(self.metadata.space, origins, directions)
        traced = self._trace_all(o, d)
        return replace(traced, depth=traced.depth / length)

    def _trace_all(self, o: np.ndarray, d: np.ndarray) -> RenderedRays:
        parts = []
        with torch.inference_mode():
            for start in range(0, len(o), CHUNK):
                rays = self._trace(self._tensor(o[start : start + CHUNK]), self._tensor(d[start : start + CHUNK]))
                parts.append([a.cpu().numpy() for a in (rays.rgb, rays.depth, rays.opacity)])
        if not parts:
            return RenderedRays(np.empty((0, 3), np.float32), np.empty(0, np.float32), np.empty(0, np.float32))
        rgb, depth, opacity = (np.concatenate(column) for column in zip(*parts, strict=True))
        return RenderedRays(np.clip(rgb, 0, 1), depth, opacity)

    def render_rays_jacobian(
        self, origins: np.ndarray, directions: np.ndarray, channel_weights: np.ndarray
    ) -> tuple[RenderedRays, np.ndarray]:
        """See RayRenderer."""
        o, d, length = normalised(self.metadata.space, origins, directions)
        ot, dt = self._tensor(o).requires_grad_(), self._tensor(d).requires_grad_()
        rays = self._trace(ot, dt)
        rows = []
        for weights in channel_weights:
            value = (rays.rgb @ self._tensor(np.asarray(weights, np.float32))).sum()
            gradients = torch.autograd.grad(value, (ot, dt), retain_graph=True)
            rows.append(torch.cat(gradients, 1).cpu().numpy())
        jacobian = np.stack(rows, axis=1)
        rgb, depth, opacity = (a.detach().cpu().numpy() for a in (rays.rgb, rays.depth, rays.opacity))
        return RenderedRays(rgb, depth / length, opacity), by_object_rays(self.metadata.space, jacobian, d, length)

    def render_view(self, camera: Camera, cam_from_object: np.ndarray) -> RenderedView:
        """See RayRenderer."""
        traced, shape = self.render_rays(*rays(camera, cam_from_object)), (camera.height, camera.width)
        rgb = (traced.rgb * np.float32(255) + np.float32(0.5)).astype(np.uint8).reshape(*shape, 3)
        depth, opacity = traced.depth.reshape(shape), traced.opacity.reshape(shape)
        return RenderedView(rgb, depth, opacity, camera, cam_from_object)

    def _trace(self, o: torch.Tensor, d: torch.Tensor) -> TwinRays:
        jitter = torch.full((len(o),), 0.5, device=o.device)
        with torch.no_grad():
            samples = self._twin.march(o, d, jitter)
        background = torch.tensor(self.metadata.background, dtype=torch.float32, device=o.device)
        return self._twin(o, d, background, samples)

    def _tensor(self, array: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(array, device=self._twin.device)


def torch_device(backend: Backend) -> torch.device:
    """The device of the torch backends. Raises ConfigError where there is no CUDA device."""
    if backend == "cuda" and not torch.cuda.is_available():
        raise ConfigError("backend cuda: torch finds no CUDA device here; use numba")
    return torch.device("cuda" if backend == "cuda" else "cpu")
