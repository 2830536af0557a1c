"""Render a field on the CPU with the compiled kernels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stages.geometry.cameras import Camera
from stages.nerf.field import Field
from stages.nerf.kernels.jacobian import render_jacobian
from stages.nerf.kernels.render import render
from stages.nerf.kernels.types import Net
from stages.nerf.kernels.vectors import WIDTH, reads_half_floats
from stages.nerf.metadata import FieldMetadata
from stages.nerf.normalise import by_object_rays, normalised, tile_view
from stages.nerf.rendering_api import RenderedRays, RenderedView
from stages.nerf.workers import Workers

PACKET = 64
PER_RAY = 4
STOP_BELOW = 5e-3
JACOBIAN_STOP_BELOW = 1e-3
CHUNK = 1024
JACOBIAN_ROWS = 8192


class NumbaRenderer:
    """Implements RayRenderer; safe to call from one thread at a time."""

    def __init__(self, field: Field, threads: int = 1, stop_below: float = STOP_BELOW):
        self.metadata: FieldMetadata = field.metadata
        self.stop_below = stop_below
        self.samples_evaluated = 0
        self._net, self._domain = _packed(field.net), field.domain()
        self._background = np.array(field.metadata.background, np.float32)
        self._workers = Workers(field.metadata.config, threads, PACKET, PACKET * PER_RAY, backward=False)
        self._jacobian_workers: Workers | None = None

    def render_rays(self, origins: np.ndarray, directions: np.ndarray) -> RenderedRays:
        """See RayRenderer."""
        o, d, length = normalised(self.metadata.space, origins, directions)
        traced = self._trace(o, d)
        return replace(traced, depth=traced.depth / length)

    def _trace(self, o: np.ndarray, d: np.ndarray) -> RenderedRays:
        n = len(o)
        rgb, depth, opacity = np.empty((n, 3), np.float32), np.empty(n, np.float32), np.empty(n, np.float32)
        jitter = np.full(n, 0.5, np.float32)
        evaluated = self._workers.each(
            n,
            int(np.clip(n // (4 * self._workers.threads), PACKET, CHUNK)),
            lambda s, a, b: render(
                self._net, self._domain, o, d, jitter, self._background, a, b,
                PER_RAY, self.stop_below, s.samples, s.rays, rgb, depth, opacity,
            ),
        )  # fmt: skip
        self.samples_evaluated += sum(evaluated)  # type: ignore[arg-type]
        return RenderedRays(np.clip(rgb, 0, 1, out=rgb), depth, opacity)

    def render_rays_jacobian(
        self, origins: np.ndarray, directions: np.ndarray, channel_weights: np.ndarray
    ) -> tuple[RenderedRays, np.ndarray]:
        """See RayRenderer. The colours are not clipped, so that they fit their derivative."""
        if self._jacobian_workers is None:
            self._jacobian_workers = Workers(
                self.metadata.config, self._workers.threads, PACKET // 2, JACOBIAN_ROWS, backward=True
            )
        o, d, length = normalised(self.metadata.space, origins, directions)
        n, k = len(o), len(channel_weights)
        rgb, depth, opacity = np.empty((n, 3), np.float32), np.empty(n, np.float32), np.empty(n, np.float32)
        jacobian = np.zeros((n, k, 6), np.float32)
        jitter = np.full(n, 0.5, np.float32)
        weights = np.ascontiguousarray(channel_weights, np.float32)
        self._jacobian_workers.each(
            n,
            PACKET // 2,
            lambda s, a, b: render_jacobian(
                self._net, self._domain, o, d, jitter, self._background, weights, a, b,
                PER_RAY, JACOBIAN_STOP_BELOW, s.samples, s.rays, rgb, depth, opacity, jacobian,
            ),
        )  # fmt: skip
        return RenderedRays(rgb, depth / length, opacity), by_object_rays(self.metadata.space, jacobian, d, length)

    def render_view(self, camera: Camera, cam_from_object: np.ndarray) -> RenderedView:
        """See RayRenderer."""
        return tile_view(self._trace, self.metadata.space, camera, cam_from_object)

    def close(self) -> None:
        """End the threads."""
        self._workers.close()
        if self._jacobian_workers is not None:
            self._jacobian_workers.close()


def _packed(net: Net) -> Net:
    """The table in half precision, as the field's file has it, where the kernels can read that: half the memory."""
    if net.table.shape[1] != WIDTH or not reads_half_floats():
        return net
    return net._replace(table=net.table.astype(np.float16).view(np.uint16))
