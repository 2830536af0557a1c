"""Render a field on the CPU with the compiled kernels."""

from __future__ import annotations

import numpy as np

from fieldpose.stages.geometry import Camera, camera_centre
from fieldpose.stages.nerf.field import Field
from fieldpose.stages.nerf.kernels.jacobian import render_jacobian
from fieldpose.stages.nerf.kernels.render import render, render_tiles
from fieldpose.stages.nerf.kernels.sight import block_centres, block_radius, tile_limits
from fieldpose.stages.nerf.kernels.types import Net
from fieldpose.stages.nerf.kernels.vectors import WIDTH, reads_half_floats
from fieldpose.stages.nerf.metadata import FieldMetadata
from fieldpose.stages.nerf.normalise import by_object_rays, normalised, normalised_points
from fieldpose.stages.nerf.rendering_api import RenderedRays, RenderedView
from fieldpose.stages.nerf.tiles import TILE, view_tiles
from fieldpose.stages.nerf.workers import Workers

PACKET = TILE * TILE
PER_RAY = 4
STOP_BELOW = 1e-2
JACOBIAN_STOP_BELOW = 1e-3
CHUNK = 1024
TILE_CHUNK = 32
JACOBIAN_ROWS = 8192


class NumbaRenderer:
    """Implements RayRenderer; safe to call from one thread at a time."""

    def __init__(self, field: Field, threads: int = 1, stop_below: float = STOP_BELOW):
        self.metadata: FieldMetadata = field.metadata
        self.stop_below = stop_below
        self.samples_evaluated = 0
        self._net, self._domain = _packed(field.net), field.domain()
        self._background = np.array(field.metadata.background, np.float32)
        self._centres = block_centres(self._domain) if self._domain.boxed else None
        self._workers = Workers(field.metadata.config, threads, PACKET, PACKET * PER_RAY, backward=False)
        self._jacobian_workers: Workers | None = None

    def render_rays(self, origins: np.ndarray, directions: np.ndarray) -> RenderedRays:
        """See RayRenderer."""
        o, d, length = normalised(self.metadata.space, origins, directions)
        n = len(o)
        rgb, depth, opacity = np.empty((n, 3), np.float32), np.empty(n, np.float32), np.empty(n, np.float32)
        jitter = np.full(n, 0.5, np.float32)
        evaluated = self._workers.each(
            n,
            self._chunk(n, PACKET, CHUNK),
            lambda s, a, b: render(
                self._net, self._domain, o, d, jitter, self._background, a, b,
                PER_RAY, self.stop_below, s.samples, s.rays, rgb, depth, opacity,
            ),
        )  # fmt: skip
        self.samples_evaluated += sum(evaluated)  # type: ignore[arg-type]
        return RenderedRays(np.clip(rgb, 0, 1, out=rgb), depth / length, opacity)

    def _chunk(self, total: int, least: int, most: int) -> int:
        """So many at once that each thread comes several times: some take much longer than others.

        A multiple of `least`: rays are traced in the same packets, and round in the same way, whatever the threads.
        """
        return int(np.clip(total // (4 * self._workers.threads) // least * least, least, most))

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
        space, tiles = self.metadata.space, view_tiles(camera)
        limits = self._limits(camera, cam_from_object)
        turn = np.ascontiguousarray(cam_from_object[:3, :3] @ space.turn.T, np.float32)
        origin = normalised_points(space, camera_centre(cam_from_object)).astype(np.float32)
        n, shape = len(tiles.pixel), (camera.height, camera.width)
        rgb, depth, opacity = np.empty((n, 3), np.uint8), np.empty(n, np.float32), np.empty(n, np.float32)
        evaluated = self._workers.each(
            len(limits),
            self._chunk(len(limits), 1, TILE_CHUNK),
            lambda s, a, b: render_tiles(
                self._net, self._domain, tiles, limits, turn, origin, np.float32(space.scale), self._background, a, b,
                PER_RAY, self.stop_below, s.samples, s.rays, rgb, depth, opacity,
            ),
        )  # fmt: skip
        self.samples_evaluated += sum(evaluated)  # type: ignore[arg-type]
        return RenderedView(
            rgb.reshape(*shape, 3), depth.reshape(shape), opacity.reshape(shape), camera, cam_from_object
        )

    def _limits(self, camera: Camera, cam_from_object: np.ndarray) -> np.ndarray:
        """Between which distances, in the field's coordinates, rays of a view's tiles can meet anything: (tiles, 2)."""
        space = self.metadata.space
        rows, columns = -(-camera.height // TILE), -(-camera.width // TILE)
        if self._centres is None:
            return _everywhere(rows * columns)
        limits = np.empty((rows, columns, 2), np.float32)
        origin = normalised_points(space, camera_centre(cam_from_object))
        intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
        turn = np.ascontiguousarray(cam_from_object[:3, :3] @ space.turn.T)
        tile_limits(self._centres, block_radius(self._domain), turn, origin, intrinsics, TILE, limits)
        return limits.reshape(-1, 2)

    def close(self) -> None:
        """End the threads."""
        self._workers.close()
        if self._jacobian_workers is not None:
            self._jacobian_workers.close()


def _everywhere(count: int) -> np.ndarray:
    limits = np.zeros((count, 2), np.float32)
    limits[:, 1] = np.inf
    return limits


def _packed(net: Net) -> Net:
    """The table in half precision, as the field's file has it, where the kernels can read that: half the memory."""
    if net.table.shape[1] != WIDTH or not reads_half_floats():
        return net
    return net._replace(table=net.table.astype(np.float16).view(np.uint16))
