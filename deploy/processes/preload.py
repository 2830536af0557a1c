"""What the stages of a run have in common, loaded before they are forked."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from fieldpose.deploy.graph import BY_NAME
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
    import fieldpose.deploy.commands.stage  # noqa: F401

    settings, path = read_settings(config), Path(field) if field else None
    with suppress(FieldposeError):
        if path is not None:
            field_of(path)
            if settings.backend == "numba" and any(BY_NAME[name].renders for name in names):
                compile_kernels(path, settings.refinement.needs_jacobian)
    if "pnp" in names:
        from fieldpose.stages.pnp.core import warm_up

        warm_up(settings.pnp)
    with suppress(FieldposeError):
        _networks(settings, names)
    hold_to(1)


@cache
def field_of(path: Path) -> Field:
    """A field's file, read once by a process and those forked from it. Raises FieldFileError."""
    from fieldpose.stages.nerf.field import load_field

    return load_field(path)


def _networks(settings: Settings, names: tuple[str, ...]) -> None:
    """Import what matching and retrieval run; a CUDA device cannot be used on both sides of a fork."""
    from fieldpose.stages.matching.core import build_matcher
    from fieldpose.stages.retrieval.core import describer

    on_cpu = replace(settings.matching, device="cpu")
    if "matching" in names:
        build_matcher(on_cpu)
    if "retrieval" in names:
        describer(on_cpu, 1)
