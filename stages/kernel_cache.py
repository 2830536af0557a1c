"""Numba's cache of compiled kernels, told of all the sources that a kernel is made of.

Numba notices changes of the file that a kernel stands in, not of those whose functions and constants the kernel uses.
So each state of a kernel's folder and of what kernels of all folders use has a cache of its own.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from typing import Any

import numba

from fieldpose.stages import fastmath

SHARED_SOURCES = (Path(fastmath.__file__),)
"""What kernels use from outside their folders."""


def cached_njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """numba.njit with a cache, for kernels that use their folder's modules and SHARED_SOURCES alone."""

    def compiled(kernel: Callable[..., Any]) -> Any:
        before = numba.config.CACHE_DIR
        numba.config.CACHE_DIR = str(cache_folder(Path(kernel.__code__.co_filename).parent))
        try:
            return numba.njit(cache=True, **options)(kernel)
        finally:
            numba.config.CACHE_DIR = before

    return compiled


def cache_folder(folder: Path) -> Path:
    """Where the kernels of a folder are cached: in numba.config.CACHE_DIR, if it is set, else beside them."""
    return Path(numba.config.CACHE_DIR or folder / "__pycache__") / f"kernels-{_state_of_folder(folder)}"


def state_of(sources: Iterable[Path]) -> str:
    """A digest of the names and contents of files."""
    digest = hashlib.sha256()
    for path in sorted(sources):
        digest.update(f"{path.name} {path.stat().st_size} ".encode() + path.read_bytes())
    return digest.hexdigest()[:16]


@cache
def _state_of_folder(folder: Path) -> str:
    return state_of([*folder.glob("*.py"), *SHARED_SOURCES])
