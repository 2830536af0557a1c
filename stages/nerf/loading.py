"""From a field file to a renderer that is ready to use."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from stages.errors import ConfigError
from stages.nerf.field import Field, load_field
from stages.nerf.renderer import NumbaRenderer
from stages.nerf.rendering_api import RayRenderer
from stages.nerf.torch_renderer import TorchRenderer

Backend = Literal["numba", "torch", "cuda"]


def load_renderer(path: str | Path, threads: int = 1, backend: Backend = "numba") -> RayRenderer:
    """Open a field for rendering. Raises FieldFileError for a bad file, ConfigError for a bad backend."""
    return make_renderer(load_field(Path(path)), threads, backend)


def make_renderer(field: Field, threads: int = 1, backend: Backend = "numba") -> RayRenderer:
    """A renderer of a field in memory, by compiled kernels, by torch on the CPU, or by torch on CUDA."""
    if backend == "numba":
        return NumbaRenderer(field, threads)
    if backend == "torch":
        return TorchRenderer(field)
    if backend == "cuda":
        import torch

        if not torch.cuda.is_available():
            raise ConfigError("backend cuda: torch finds no CUDA device here; use numba")
        return TorchRenderer(field, "cuda")
    raise ConfigError(f"backend {backend!r}: expected numba, torch or cuda")


def warm_up(renderer: RayRenderer, jacobian: bool = False) -> None:
    """Render a few rays, so that kernels are compiled (or fetched from the cache) before the first frame."""
    origins = np.zeros((8, 3), np.float32)
    directions = np.tile(np.array([[0, 0, 1]], np.float32), (8, 1))
    renderer.render_rays(origins, directions)
    if jacobian:
        renderer.render_rays_jacobian(origins, directions, np.eye(3, dtype=np.float32))
