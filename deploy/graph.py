"""THE graph: every process, what it reads and writes, and what its handler is made of.

Launching, waiting, timing, the commands' choices, thread budgets and the README's picture all follow from the rows.
The same handlers run as processes over Zenoh (`deploy.processes`) and in one process (`deploy.local`).

Processes are started together and restarted when they die. One that ends with exit code 0 has done its work (the
camera, at the end of its source), one that ends with 2 was given something that only the user can mend; neither comes
back.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from fieldpose.bus.node import Handler
from fieldpose.bus.protocol import Bus
from fieldpose.bus.topics import (
    ALL,
    CAMERA_INFO,
    CONTROL,
    CORRESPONDENCES,
    ESTIMATE,
    FAILURE,
    FOLLOWED,
    FRAME,
    GUESS,
    MATCHES,
    POSE,
    PRIOR,
    RETRIEVED,
    SEARCH,
    STATE,
    STATS,
    TRUTH,
    VIEW,
    Topic,
    shared_address,
)  # fmt: skip
from fieldpose.deploy.parts import Parts
from fieldpose.deploy.plan import Plan
from fieldpose.deploy.recording_options import RecordingOptions
from fieldpose.errors import ConfigError, UsageError
from fieldpose.stages.camera.sources import EXTERNAL, knows_truth
from fieldpose.stages.cores import usable_cores

HUB, RECORDER, CAMERA = "hub", "recorder", "camera"
OBSERVER = "observer"
"""The name under which the command itself listens."""

_THREAD_VARIABLES = (
    "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "VECLIB_MAXIMUM_THREADS",
)  # fmt: skip

Topics = tuple[Topic[Any], ...]


@dataclass(frozen=True)
class Launch:
    """What only a process has.

    bus; record: what it records into; recording: how; plans: of all pipelines that it serves; wait_until_ready:
    returns once all are.
    """

    bus: Bus | None = None
    record: Path | None = None
    recording: RecordingOptions = field(default_factory=RecordingOptions)
    plans: tuple[Plan, ...] = ()
    wait_until_ready: Callable[[], None] = lambda: None


@dataclass(frozen=True)
class Process:
    """A row of the graph.

    reads: all that its handler may join or listen to; one with less to do reads less. needs_field: it cannot start
    without. serves: one pipeline, all of a camera, or all of a run, in turn. renders: it runs the field's kernels.
    parallel: its work can use several threads. solves: where every frame is followed, its work is beside that and gives
    way to it. stop_s: how long it may take to end. wanted: whether a plan has work for it.
    """

    name: str
    make: Callable[[Parts, Launch], Handler] | None
    reads: Topics = ()
    writes: Topics = ()
    needs_field: bool = False
    serves: Literal["pipeline", "camera", "run"] = "run"
    renders: bool = False
    parallel: bool = False
    solves: bool = False
    stop_s: float = 2.0
    wanted: Callable[[Plan], bool] = lambda plan: True


def _recorder(parts: Parts, launch: Launch) -> Handler:
    from fieldpose.bus.recorder import RecorderHandler
    from fieldpose.deploy.reporting.provenance import attachments, metadata
    from fieldpose.stages.nerf.field import load_metadata

    options = launch.recording
    if launch.bus is None or (launch.record is None and options.snapshots is None):
        raise UsageError("the recorder needs --record FILE.mcap, or --record.snapshots DIR")
    plans = launch.plans or (parts.plan,)
    options.check_form(launch.record, len(plans))
    address = shared_address([plan.settings.address for plan in plans])
    about, attached = metadata(plans), attachments(plans)
    path = None if options.format == "fieldpose" else plans[0].field
    known = None if path is None else load_metadata(path)
    store = options.store(launch.record, address, about, attached, known, resume=True, from_start=True)
    return RecorderHandler(launch.bus, address, store, options.keep(about, attached))


def _camera(parts: Parts, launch: Launch) -> Handler:
    from fieldpose.stages.camera.node import CameraNode

    config = parts.settings.camera
    # A source that knows its frames' poses knows their cameras too.
    known = tuple if config.source and knows_truth(config.source) else parts.known_cameras
    return CameraNode(config, known, launch.wait_until_ready)


def check_camera(plan: Plan) -> None:
    """Raise ConfigError for a camera that is to send true poses under another object's key."""
    wanted, own = plan.settings.camera.truth_of, plan.settings.address.object
    if wanted not in (None, own):
        raise ConfigError(
            f"camera: truth_of is {wanted}, but this camera is of the object {own}; give --address.object"
        )


def _perturbation(parts: Parts, launch: Launch) -> Handler:
    from fieldpose.deploy.evaluation.perturbation import PerturbationNode

    plan = parts.plan
    return PerturbationNode(plan.begins.disturbance, plan.settings.tracking.seed, plan.object_from_dataset())


def _tracking(parts: Parts, launch: Launch) -> Handler:
    from fieldpose.stages.tracking.node import TrackingNode

    return TrackingNode(parts.tracker, parts.see())


def _retrieval(parts: Parts, launch: Launch) -> Handler:
    from fieldpose.stages.retrieval.node import RetrievalNode

    return RetrievalNode(lambda: parts.training_views, parts.describe, parts.settings.retrieval, parts.images)


def _rendering(parts: Parts, launch: Launch) -> Handler:
    from fieldpose.stages.rendering.node import RenderingNode

    return RenderingNode(lambda: parts.views)


def _matching(parts: Parts, launch: Launch) -> Handler:
    from fieldpose.stages.matching.node import MatchingNode

    return MatchingNode(lambda: parts.pairs, parts.images, parts.settings.rendering.longer_side)


def _lifting(parts: Parts, launch: Launch) -> Handler:
    from fieldpose.stages.lifting.node import LiftingNode

    return LiftingNode(lambda: parts.renderer, parts.settings.lifting, parts.consistency)


def _pnp(parts: Parts, launch: Launch) -> Handler:
    from fieldpose.stages.pnp.node import PnpNode

    return PnpNode(parts.settings.pnp, parts.images)


def _refinement(parts: Parts, launch: Launch) -> Handler:
    from fieldpose.stages.refinement.node import RefinementNode

    return RefinementNode(lambda: parts.renderer, parts.settings.refinement, parts.images)


GRAPH: tuple[Process, ...] = (
    Process(HUB, None, stop_s=1.0),
    Process(RECORDER, _recorder, reads=tuple(topic for topic in ALL if topic.recorded), stop_s=60.0),
    Process(
        CAMERA, _camera, reads=(STATE, POSE, FAILURE), writes=(TRUTH, FRAME, CAMERA_INFO), serves="camera",
        wanted=lambda plan: plan.settings.camera.source != EXTERNAL,
    ),
    Process(
        "perturbation", _perturbation, reads=(TRUTH,), writes=(PRIOR,), serves="pipeline",
        wanted=lambda plan: plan.begins.disturbance is not None,
    ),
    Process(
        "tracking", _tracking, reads=(FRAME, CAMERA_INFO, PRIOR, VIEW, RETRIEVED, POSE, FAILURE),
        writes=(SEARCH, GUESS, FOLLOWED, STATE, CONTROL), needs_field=True, serves="pipeline",
    ),
    Process(
        "retrieval", _retrieval, reads=(SEARCH, FRAME), writes=(RETRIEVED, FAILURE), needs_field=True, solves=True,
        wanted=lambda plan: plan.looks,
    ),
    Process(
        "rendering", _rendering, reads=(GUESS,), writes=(VIEW, FAILURE), needs_field=True, renders=True, parallel=True,
        solves=True,
    ),
    Process("matching", _matching, reads=(VIEW, FRAME), writes=(MATCHES, FAILURE), parallel=True, solves=True),
    Process(
        "lifting", _lifting, reads=(MATCHES, VIEW), writes=(CORRESPONDENCES, FAILURE), needs_field=True, renders=True,
        parallel=True, solves=True,
    ),
    Process("pnp", _pnp, reads=(CORRESPONDENCES, VIEW, FRAME), writes=(ESTIMATE, FAILURE), solves=True),
    Process(
        "refinement", _refinement, reads=(ESTIMATE, FRAME), writes=(POSE, FAILURE), needs_field=True, renders=True,
        parallel=True, solves=True,
    ),
)  # fmt: skip
BY_NAME: dict[str, Process] = {row.name: row for row in GRAPH}
STAGES: tuple[str, ...] = tuple(row.name for row in GRAPH if row.writes)
"""The processes that take part in the dataflow."""
_AROUND_STAGES = (FRAME, CAMERA_INFO, TRUTH, PRIOR, STATE, CONTROL, STATS)
BETWEEN_STAGES: Topics = tuple(topic for topic in ALL if topic not in _AROUND_STAGES)
"""The topics of a frame on its way from the door to its pose."""

AT_WORK: tuple[str, ...] = tuple(row.name for row in GRAPH if any(topic in BETWEEN_STAGES for topic in row.writes))
"""The processes that a frame passes on that way."""


def rows_of(plan: Plan, recorded: bool) -> list[Process]:
    """The processes of a run of a plan, the hub among them."""
    return [row for row in GRAPH if row.wanted(plan) and (recorded or row.name != RECORDER)]


def threads_of(row: Process, depth: int, cores: int | None = None) -> int:
    """A process's budget: with `depth` frames in flight as many processes are at work at once."""
    cores = cores or usable_cores()
    return max(1, cores // min(depth, cores)) if row.parallel else 1


def thread_environment(threads: int) -> dict[str, str]:
    """Environment variables that hold the numeric libraries to a budget; idle threads sleep instead of spinning."""
    return {**dict.fromkeys(_THREAD_VARIABLES, str(threads)), "OMP_WAIT_POLICY": "passive", "KMP_BLOCKTIME": "0"}
