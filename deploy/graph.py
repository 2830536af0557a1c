"""THE table of processes: what each is made of, whether it needs the field, how many threads it may use.

All are started together and restarted when they die. One that ends with exit code 0 has done its work (the camera,
at the end of its source), one that ends with 2 was given something that only the user can mend; neither comes back.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from fieldpose.bus.node import Handler
from fieldpose.bus.protocol import Bus
from fieldpose.deploy.errors import UsageError
from fieldpose.deploy.settings import Settings

HUB, RECORDER, CAMERA = "hub", "recorder", "camera"
OBSERVER = "observer"
"""The name under which the command itself listens."""

_THREAD_VARIABLES = (
    "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "VECLIB_MAXIMUM_THREADS",
)  # fmt: skip


@dataclass(frozen=True)
class Launch:
    """What a process is made with; `threads` is its budget, `wait_until_ready` returns once all others are."""

    bus: Bus
    settings: Settings
    threads: int
    field: Path | None
    record: Path | None
    wait_until_ready: Callable[[], None]

    def needed_field(self) -> Path:
        """The field. Raises UsageError where none was given."""
        if self.field is None:
            raise UsageError("this process needs --field FIELD")
        return self.field


@dataclass(frozen=True)
class ProcessSpec:
    """A row of the table.

    `parallel`: its work can use several threads; `renders`: it runs the field's kernels; `stop_s`: how long it
    may take to end.
    """

    name: str
    handler: Callable[[Launch], Handler] | None
    parallel: bool = False
    renders: bool = False
    stop_s: float = 2.0


def _recorder(launch: Launch) -> Handler:
    from fieldpose.bus.recorder import RecorderHandler
    from fieldpose.deploy.reporting.provenance import attachments, metadata

    if launch.record is None:
        raise UsageError("the recorder needs --record FILE.mcap")
    return RecorderHandler(
        launch.bus,
        launch.settings.address,
        launch.record,
        metadata=metadata(launch.settings, launch.field),
        attachments=attachments(launch.settings, launch.field),
        resume=True,
        from_start=True,
    )


def _camera(launch: Launch) -> Handler:
    from fieldpose.stages.camera.node import CameraNode

    return CameraNode(launch.settings.camera, launch.wait_until_ready)


def _tracking(launch: Launch) -> Handler:
    from fieldpose.stages.tracking.node import TrackingNode

    return TrackingNode(launch.needed_field(), launch.settings.tracking)


def _retrieval(launch: Launch) -> Handler:
    from fieldpose.stages.retrieval.node import RetrievalNode

    return RetrievalNode(launch.needed_field(), launch.settings.retrieval, launch.settings.matching)


def _rendering(launch: Launch) -> Handler:
    from fieldpose.stages.rendering.node import RenderingNode

    return RenderingNode(launch.needed_field(), launch.settings.rendering, launch.threads)


def _matching(launch: Launch) -> Handler:
    import torch

    from fieldpose.stages.matching.node import MatchingNode

    torch.set_num_threads(launch.threads)
    return MatchingNode(launch.settings.matching)


def _lifting(launch: Launch) -> Handler:
    from fieldpose.stages.lifting.node import LiftingNode

    return LiftingNode(launch.needed_field(), launch.settings.lifting, launch.threads)


def _pnp(launch: Launch) -> Handler:
    from fieldpose.stages.pnp.node import PnpNode

    return PnpNode(launch.settings.pnp)


def _refinement(launch: Launch) -> Handler:
    from fieldpose.stages.refinement.node import RefinementNode

    return RefinementNode(launch.needed_field(), launch.settings.refinement, launch.threads)


TABLE: dict[str, ProcessSpec] = {
    spec.name: spec
    for spec in (
        ProcessSpec(HUB, None, stop_s=1.0),
        ProcessSpec(RECORDER, _recorder, stop_s=60.0),
        ProcessSpec(CAMERA, _camera),
        ProcessSpec("tracking", _tracking),
        ProcessSpec("retrieval", _retrieval),
        ProcessSpec("rendering", _rendering, parallel=True, renders=True),
        ProcessSpec("matching", _matching, parallel=True),
        ProcessSpec("lifting", _lifting, parallel=True, renders=True),
        ProcessSpec("pnp", _pnp),
        ProcessSpec("refinement", _refinement, parallel=True, renders=True),
    )
}
STAGES = tuple(name for name in TABLE if name not in (HUB, RECORDER))
"""The processes that a frame passes."""


def threads_of(spec: ProcessSpec, depth: int, cores: int | None = None) -> int:
    """A process's budget: with `depth` frames in flight as many processes are at work at once."""
    cores = cores or len(os.sched_getaffinity(0))
    return max(1, cores // min(depth, cores)) if spec.parallel else 1


def thread_environment(threads: int) -> dict[str, str]:
    """Environment variables that hold the numeric libraries to a budget; idle threads sleep instead of spinning."""
    return {**dict.fromkeys(_THREAD_VARIABLES, str(threads)), "OMP_WAIT_POLICY": "passive", "KMP_BLOCKTIME": "0"}
