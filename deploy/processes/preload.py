"""What the stages of a run have in common, loaded before they are forked."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from fieldpose.deploy.processes.forking import beside
from fieldpose.deploy.processes.threads import hold_to
from fieldpose.deploy.processes.warmup import compile_kernels
from fieldpose.deploy.settings import Settings, read_file, read_settings
from fieldpose.errors import ConfigError, FieldposeError

if TYPE_CHECKING:
    from fieldpose.stages.nerf.field import Field


class Pipeline(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What the processes of a pipeline are started with: a file of settings, a field's file, and their names."""

    settings: str
    field: str | None
    processes: tuple[str, ...]

    def within(self, folder: Path) -> Pipeline:
        """The same, where its paths count from a folder."""
        field = None if self.field is None else str(folder / self.field)
        return msgspec.structs.replace(self, settings=str(folder / self.settings), field=field)

    def read(self) -> tuple[Settings, Path | None]:
        """Its settings, and where its field is. Raises ConfigError."""
        return read_settings(self.settings), None if self.field is None else Path(self.field)


def pipelines_of(file: str | Path) -> list[Pipeline]:
    """The pipelines of a run, as `programs` has listed them; paths count from the file's folder. Raises ConfigError."""
    content, folder = read_file(Path(file)), Path(file).parent
    try:
        listed = msgspec.convert(content.get("pipelines"), list[Pipeline])
    except msgspec.ValidationError as error:
        raise ConfigError(f"{file}: no list of pipelines as `fieldpose run` leaves it: {error}") from error
    return [one.within(folder) for one in listed]


def preload(file: str) -> None:
    """Load what the processes of a run need, whose pipelines a file lists; no thread is started.

    What goes wrong is left to the process that needs it, which tells.
    """
    hold_to(1)
    pipelines = pipelines_of(file)
    kernels = [partial(_of_each, work, name, pipelines) for name, work in _KERNELS.items()]
    for module in _IMPORTED:
        importlib.import_module(module)
    # Compiled by others the first time, which takes half a minute and memory that would stay; then only read.
    with beside(*kernels):
        for pipeline in pipelines:
            _networks(pipeline.read()[0], pipeline.processes)
    for work in kernels:
        work()
    hold_to(1)


def _of_each(work: Callable[[Settings, Path | None], None], name: str, pipelines: Sequence[Pipeline]) -> None:
    for pipeline in pipelines:
        if name in pipeline.processes:
            work(*pipeline.read())


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


_IMPORTED = (
    "fieldpose.deploy.commands.stage", "fieldpose.deploy.access.certificates", "fieldpose.stages.nerf.loading",
    "fieldpose.stages.pnp.core",
)  # fmt: skip
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
