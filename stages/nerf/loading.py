"""From a field file to a renderer that is ready to use."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fieldpose.stages.geometry import Camera
from fieldpose.stages.nerf.backend import resolved
from fieldpose.stages.nerf.config import Backend
from fieldpose.stages.nerf.field import Field, load_field
from fieldpose.stages.nerf.renderer import NumbaRenderer
from fieldpose.stages.nerf.rendering_api import RayRenderer


def load_renderer(path: str | Path, threads: int = 1, backend: Backend = "auto") -> RayRenderer:
    """Open a field for rendering. Raises FieldFileError for a bad file, ConfigError for a bad backend."""
    return make_renderer(load_field(Path(path)), threads, backend)


def make_renderer(field: Field, threads: int = 1, backend: Backend = "auto") -> RayRenderer:
    """A renderer of a field in memory. Raises ConfigError where there is no CUDA device."""
    backend = resolved(backend)
    if backend == "numba":
        return NumbaRenderer(field, threads)
    # Torch takes 200 MB and seconds to import; a process that only renders on the CPU does without.
    from fieldpose.stages.nerf.torch_renderer import TorchRenderer, torch_device

    return TorchRenderer(field, torch_device(backend))


def warm_up(renderer: RayRenderer, jacobian: bool = False) -> None:
    """Render a few rays and a view, so that kernels are compiled (or fetched from the cache) before the first frame."""
    origins = np.zeros((8, 3), np.float32)
    directions = np.tile(np.array([[0, 0, 1]], np.float32), (8, 1))
    renderer.render_rays(origins, directions)
    renderer.render_view(Camera(8, 8, 8.0, 8.0, 3.5, 3.5), np.eye(4))
    if jacobian:
        renderer.render_rays_jacobian(origins, directions, np.eye(3, dtype=np.float32))
