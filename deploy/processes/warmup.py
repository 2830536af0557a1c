"""Compiling the field's kernels once for all processes, before any of them is ready."""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from fieldpose.bus.logs import stage_logger

_WORTH_TELLING_S = 3.0


@cache
def compile_kernels(field: Path, jacobian: bool = False) -> None:
    """Have the rendering kernels compiled, or fetched from the cache that processes share.

    Processes take turns, so that the first compiles and the others find the result; one forked from a process that
    has done so finds them in its memory. Raises FieldFileError.
    """
    from fieldpose.stages.nerf.loading import load_renderer, warm_up

    with one_at_a_time():
        began = time.monotonic()
        warm_up(load_renderer(field, backend="numba"), jacobian)
        seconds = time.monotonic() - began
    if seconds > _WORTH_TELLING_S:
        stage_logger("kernels").info("compiled the kernels, for this and the next start", seconds=round(seconds, 1))


@contextmanager
def one_at_a_time() -> Iterator[None]:
    """Hold this user's lock on compiling into the cache; the kernel lets go of it if the process dies.

    Where there is no cache, everybody compiles at once. The lock is beside what is compiled, for services and
    containers may share a cache and no other folder.
    """
    from fieldpose.stages.kernel_cache import cache_folder
    from fieldpose.stages.nerf import kernels

    folder = cache_folder(Path(kernels.__file__).parent)
    if folder is None:
        yield
        return
    with (folder / f"compiling-{os.getuid()}.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
