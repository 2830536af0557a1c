"""By what a field is rendered and learnt on this machine."""

from __future__ import annotations

from pathlib import Path

from fieldpose.stages.nerf.config import Backend

_DRIVERS = "/proc/driver/nvidia/version", "/dev/nvidiactl", "/dev/dxg"
"""Of NVIDIA on Linux, and on Linux under Windows."""


def resolved(backend: Backend) -> Backend:
    """The backend that "auto" means on this machine: cuda where torch finds a device, else numba."""
    if backend != "auto":
        return backend
    # Torch takes seconds to import: it is only asked where there is a driver to be asked.
    if not any(Path(path).exists() for path in _DRIVERS):
        return "numba"
    import torch

    return "cuda" if torch.cuda.is_available() else "numba"
