"""What the stages of a run have in common, loaded before they are forked."""

from __future__ import annotations

import importlib
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

from fieldpose.deploy.processes.forking import beside
from fieldpose.deploy.processes.threads import hold_to
from fieldpose.deploy.processes.warmup import compile_kernels
from fieldpose.deploy.settings import Settings, read_settings
from fieldpose.errors import FieldposeError

if TYPE_CHECKING:
    from fieldpose.stages.nerf.field import Field


def preload(config: str, field: str, *names: str) -> None:
    """Load what the processes of these names need, with the settings in a file and a field; no thread is started.

    What goes wrong is left to the process that needs it, which tells.
    """
    hold_to(1)
    settings, path = read_settings(config), Path(field) if field else None
    kernels = [partial(work, settings, path) for name, work in _KERNELS.items() if name in names]
    for module in _IMPORTED:
        importlib.import_module(module)
    # Compiled by others the first time, which takes half a minute and memory that would stay; then only read.
    with beside(*kernels):
        _networks(settings, names)
    for work in kernels:
        work()
    hold_to(1)


@cache
def field_of(path: Path) -> Field:
    """A field's file, read once by a process and those forked from it. Raises FieldFileError."""
    from fieldpose.stages.nerf.field import load_field

    return load_field(path)


def _rendering(settings: Settings, field: Path | None) -> None:
    with suppress(FieldposeError):
        if field is not None:
            field_of(field)
        if field is not None and settings.backend == "numba":
            compile_kernels(field, settings.refinement.needs_jacobian)


def _pnp(settings: Settings, field: Path | None) -> None:
    from fieldpose.stages.pnp.core import warm_up

    warm_up(settings.pnp)


def _tracking(settings: Settings, field: Path | None) -> None:
    from fieldpose.stages.following.core import warm_up

    if settings.following.when == "always":
        warm_up()


_IMPORTED = ("fieldpose.deploy.commands.stage", "fieldpose.stages.nerf.loading", "fieldpose.stages.pnp.core")
_KERNELS = {"rendering": _rendering, "pnp": _pnp, "tracking": _tracking}
"""By the process that cannot do without."""


def _networks(settings: Settings, names: tuple[str, ...]) -> None:
    """Import what matching and retrieval run; a CUDA device cannot be used on both sides of a fork."""
    from fieldpose.stages.matching.core import build_matcher
    from fieldpose.stages.retrieval.core import describer

    on_cpu = replace(settings.matching, device="cpu")
    with suppress(FieldposeError):
        if "matching" in names:
            build_matcher(on_cpu)
        if "retrieval" in names:
            describer(on_cpu, 1)
