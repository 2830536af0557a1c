"""Numba's cache of compiled kernels, told of all the sources that a kernel is made of.

Numba notices changes of the file that a kernel stands in, not of those whose functions and constants the kernel uses.
So each state of a kernel's folder and of what kernels of all folders use has a cache of its own.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
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
        before, folder = numba.config.CACHE_DIR, cache_folder(Path(kernel.__code__.co_filename).parent)
        if folder is None:
            return numba.njit(**options)(kernel)
        numba.config.CACHE_DIR = str(folder)
        try:
            return numba.njit(cache=True, **options)(kernel)
        finally:
            numba.config.CACHE_DIR = before

    return compiled


def cache_folder(folder: Path) -> Path | None:
    """Where the kernels of a folder are cached, None where nothing can be written: then each process compiles them.

    The first that can be written of numba.config.CACHE_DIR, if it is set, their own folder, the user's cache, and the
    user's own folder for what is temporary.
    """
    name = f"kernels-{_state_of_folder(folder)}"
    return next((place / name for place in _places(folder) if _is_writable(place / name)), None)


def _places(folder: Path) -> Iterator[Path]:
    if numba.config.CACHE_DIR:
        yield Path(numba.config.CACHE_DIR)
    yield folder / "__pycache__"
    with suppress(RuntimeError):  # no home
        yield Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "fieldpose"
    temporary = Path(tempfile.gettempdir()) / f"fieldpose-{os.getuid()}"
    with suppress(OSError):
        temporary.mkdir(mode=0o700, exist_ok=True)
        # What is cached is run: nobody else may have put it there.
        if temporary.lstat().st_uid == os.getuid() and not temporary.lstat().st_mode & 0o022:
            yield temporary


@cache
def _is_writable(place: Path) -> bool:
    try:
        place.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=place):
            return True
    except OSError:
        return False


def state_of(sources: Iterable[Path]) -> str:
    """A digest of the names and contents of files."""
    digest = hashlib.sha256()
    for path in sorted(sources):
        digest.update(f"{path.name} {path.stat().st_size} ".encode() + path.read_bytes())
    return digest.hexdigest()[:16]


@cache
def _state_of_folder(folder: Path) -> str:
    return state_of([*folder.glob("*.py"), *SHARED_SOURCES])
