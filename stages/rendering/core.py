"""Rendering the field where the camera is guessed to be, or finding a view from near there that exists already."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from dataclasses import dataclass

import numpy as np

from fieldpose.bus.messages import Reason
from fieldpose.stages.geometry import Camera, points_at_depth, viewing_angles
from fieldpose.stages.geometry.arrays import Points64, Transform
from fieldpose.stages.nerf.rendering_api import RayRenderer, RenderedView
from fieldpose.stages.rendering.config import RenderingConfig

__all__ = ["RenderingConfig", "SourcedView", "ViewSource", "opacity_bytes", "view_camera"]

_PROBES = 256


@dataclass(frozen=True)
class SourcedView:
    """A view, its id, whether it was rendered for an earlier guess, and the share of pixels that show something."""

    view: RenderedView
    view_id: str
    reused: bool
    visible: float


class ViewSource:
    """Views of one field. `field_id` tells its views from another field's."""

    def __init__(self, renderer: RayRenderer, config: RenderingConfig | None = None, field_id: str = "") -> None:
        self._renderer, self._config, self._field_id = renderer, config or RenderingConfig(), field_id
        self._cache: OrderedDict[str, _Cached] = OrderedDict()

    def view(self, camera: Camera, cam_from_object: Transform, next_pass: bool = False) -> SourcedView | Reason:
        """The view of a frame's camera (undistorted, shrunk) at the guess or near it; nearer in a next pass.

        NOTHING_IN_VIEW where it shows too little.
        """
        found = self._found(camera, cam_from_object, next_pass)
        return found if found.visible >= self._config.min_visible else Reason.NOTHING_IN_VIEW

    def _found(self, camera: Camera, cam_from_object: Transform, next_pass: bool) -> SourcedView:
        small = view_camera(camera, self._config.longer_side)
        view_id = _view_id(self._field_id, small, cam_from_object)
        found = view_id if view_id in self._cache else self._near(small, cam_from_object, next_pass)
        if found is not None:
            self._cache.move_to_end(found)
            cached = self._cache[found]
            return SourcedView(cached.view, found, True, cached.visible)
        view = self._renderer.render_view(small, cam_from_object)
        cached = _Cached(view, float((view.opacity > 0.5).mean()), _probes(view))
        self._keep(view_id, cached)
        return SourcedView(view, view_id, False, cached.visible)

    def _near(self, camera: Camera, cam_from_object: Transform, next_pass: bool) -> str | None:
        """The id of the cached view with the smallest shift among those within the limits."""
        if self._config.reuse_within_deg <= 0:
            return None
        share = self._config.next_pass_share if next_pass else 1.0
        best, best_shift = None, share * self._config.reuse_shift
        for view_id, cached in self._cache.items():
            if cached.view.camera == camera:
                angle_deg, shift = _difference(cached, cam_from_object)
                if angle_deg <= share * self._config.reuse_within_deg and shift <= best_shift:
                    best, best_shift = view_id, shift
        return best

    def _keep(self, view_id: str, cached: _Cached) -> None:
        self._cache[view_id] = cached
        while sum(entry.size_bytes for entry in self._cache.values()) > self._config.cache_mb * 2**20:
            self._cache.popitem(last=False)


def view_camera(camera: Camera, size: int) -> Camera:
    """The camera without distortion, its longer side at most `size` pixels."""
    return camera.undistorted().shrunk(size)


def opacity_bytes(opacity: np.ndarray) -> np.ndarray:
    """Opacity 0..1, as a view on the bus has it: uint8 0..255."""
    return np.rint(opacity * 255).astype(np.uint8)


@dataclass(frozen=True)
class _Cached:
    """A view, its visible share, and surface points in it, in object coordinates."""

    view: RenderedView
    visible: float
    probes: Points64

    @property
    def size_bytes(self) -> int:
        view = self.view
        return view.rgb.nbytes + view.depth.nbytes + view.opacity.nbytes + self.probes.nbytes


def _probes(view: RenderedView) -> Points64:
    surface = np.flatnonzero((view.opacity > 0.5) & (view.depth > 0))
    chosen = surface[np.linspace(0, len(surface) - 1, min(_PROBES, len(surface))).astype(int)]
    y, x = np.divmod(chosen, view.camera.width)
    points = points_at_depth(view.camera, view.cam_from_object, np.stack([x, y], axis=1), view.depth[y, x])
    return points.astype(np.float64)


def _difference(cached: _Cached, cam_from_object: Transform) -> tuple[float, float]:
    """How differently a guess sees the surface points of a cached view; infinite if it has none of them in front.

    The median angle in degrees between the directions in which they are seen, and the root mean square shift of
    their pixels as a share of the longer side.
    """
    camera, old = cached.view.camera, cached.view.cam_from_object
    now = camera.project(cached.probes @ cam_from_object[:3, :3].T + cam_from_object[:3, 3])
    before = camera.project(cached.probes @ old[:3, :3].T + old[:3, 3])
    if len(now) == 0 or not np.isfinite(now).all():
        return np.inf, np.inf
    shift = np.sqrt(((now - before) ** 2).sum(axis=1).mean()) / max(camera.width, camera.height)
    return float(np.rad2deg(np.median(viewing_angles(cached.probes, old, cam_from_object)))), float(shift)


def _view_id(field_id: str, camera: Camera, cam_from_object: Transform) -> str:
    digest = hashlib.sha256(f"{field_id} {camera}".encode())
    digest.update(np.ascontiguousarray(cam_from_object, dtype="<f8").tobytes())
    return digest.hexdigest()[:16]
