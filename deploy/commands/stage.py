"""One process of the pipeline in the foreground."""

from __future__ import annotations

import dataclasses
import os
import sys
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from fieldpose.bus.logs import stage_logger
from fieldpose.bus.node import Handler, run_nodes
from fieldpose.bus.refusals import log_to_stderr
from fieldpose.bus.signals import Interrupted, StopSignals
from fieldpose.bus.transport import LOCAL_HUB, serve_hub, wait_for
from fieldpose.deploy.access.joining import Entry, access_as, check_kept_out, hub_keys, joint
from fieldpose.deploy.graph import (
    AT_WORK,
    BY_NAME,
    CAMERA,
    GRAPH,
    HUB,
    RECORDER,
    STAGES,
    Launch,
    Process,
    check_camera,
    rows_of,
    threads_of,
)  # fmt: skip
from fieldpose.deploy.parts import Parts
from fieldpose.deploy.plan import Plan, resolve
from fieldpose.deploy.processes.endpoints import with_scheme
from fieldpose.deploy.processes.lifeline import die_with_parent
from fieldpose.deploy.processes.preload import field_of, pipelines_of
from fieldpose.deploy.processes.threads import hold_to
from fieldpose.deploy.processes.warmup import compile_kernels
from fieldpose.deploy.recording_options import RecordingOptions, with_start
from fieldpose.deploy.settings import Settings
from fieldpose.deploy.sharing import Share
from fieldpose.errors import UsageError

if TYPE_CHECKING:
    from fieldpose.stages.nerf.field import Field

_START_S = 300.0
"""Others may be compiling their kernels."""
_GIVES_WAY = 10
"""How nice a process is whose work must not be in the way of following: for ten times less of a core both want."""


_Name = Annotated[str, tyro.conf.arg(constructor=tyro.extras.literal_type_from_choices(list(BY_NAME)))]
_WITH_FIELD = ", ".join(row.name for row in GRAPH if row.needs_field)
_FIELD = (
    f"The field, for {_WITH_FIELD}, and for the camera, which looks there for cameras that are not calibrated, "
    "and the recorder, which keeps what was decided for the field."
)


@dataclass(frozen=True)
class Options:
    """Run one process of the pipeline in the foreground, for another host or a debugger.

    Example: fieldpose stage matching --connect tcp/10.0.0.2:7447 --matching.matcher sift
    """

    name: tyro.conf.Positional[_Name]
    """Which process."""
    connect: str = LOCAL_HUB
    """Where the hub is."""
    listen: str | None = None
    """Where this process listens: the hub for everybody (default: the address of --connect), any other for the
    processes that it exchanges messages with (default: any port, for this machine alone if the hub is on it)."""
    field: Annotated[Path | None, tyro.conf.arg(help=_FIELD)] = None
    record: Path | None = None
    """The recorder's file (.mcap); {start} in its name becomes the time at which it is started."""
    recording: Annotated[RecordingOptions, tyro.conf.arg(name="record")] = dataclasses.field(
        default_factory=RecordingOptions
    )
    pipelines: Path | None = None
    """A file that lists several pipelines, their settings and fields; this process serves them in turn."""
    share: str | None = None
    """Which part of these it serves where several processes of one stage do, each with its own part: 1/2 and 2/2. As
    many each, or one more; a pipeline is never split."""
    join: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Another hub that this hub passes messages to and from, where a site has one for each of several groups of hosts;
    may be given again. Who is ready is known within a group."""
    shared_memory: bool = True
    """Exchange images with processes of this host through /dev/shm; not possible where it is not shared, as between
    most containers."""
    threads: int | None = None
    """Threads that it may use (default: by the graph)."""
    wait_for: tuple[str, ...] | None = None
    """Processes that must be ready before this one begins, those of other pipelines as OBJECT/CAMERA/PROCESS (default:
    none, and for the camera, which sends nothing before they are, all that its frames pass)."""
    entry: Annotated[Entry, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Entry)
    config: Path | None = None
    """TOML or JSON file of settings."""
    settings: Annotated[Settings, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Settings)

    def run(self) -> int:
        """Serve until SIGTERM, Ctrl-C, or the end of the source."""
        supervised = "SUPERVISOR_ENABLED" in os.environ
        if supervised:
            die_with_parent()
        row = BY_NAME[self.name]
        log = log_to_stderr(roles=row.make is None, say=stage_logger(row.name).warning)
        if row.make is None:
            _serve_hub(self.listen or self.connect, self.entry, self.join)
        else:
            _serve(self, row, row.make)
        if supervised:
            # Everything is closed, and Python would take two seconds to take the numeric libraries apart.
            log.close()
            sys.stderr.flush()
            os._exit(0)
        return 0


def _serve_hub(listen: str, entry: Entry, others: tuple[str, ...]) -> None:
    with hub_keys(listen, entry) as (at, keys):
        those = others if keys is None else tuple(with_scheme(other, "tls") for other in others)
        serve_hub(at, access=None if keys is None else access_as(keys, HUB), others=those)


def _serve(options: Options, row: Process, make: Callable[[Parts, Launch], Handler]) -> None:
    if options.join:
        raise UsageError(f"--join is of the hub; {row.name} joins one by --connect")
    served = _served(options, row)
    plans = tuple(plan for plan, _ in served)
    threads = options.threads or threads_of(row, max(plan.in_flight for plan in plans))
    hold_to(threads)
    each = [_parts(plan, field, threads, row) for plan, field in served]
    address = plans[0].settings.address
    # In whatever order they are started, the first frame finds all that work on it.
    awaited = options.wait_for if options.wait_for is not None else _passed(plans[0]) if row.name == CAMERA else ()
    if row.name == CAMERA:
        check_camera(plans[0])
    if row.solves and any(plan.follows for plan in plans):
        os.nice(_GIVES_WAY)
    way = joint(options.connect, options.entry, (row.name,), _START_S)
    if options.listen is not None and way.access is None and not options.entry.open:
        check_kept_out(options.listen)
    bus = way.session(options.listen, options.shared_memory)
    for plan in plans:
        _tell(plan, row)

    def wait_until_ready() -> None:
        wait_for(bus, address, awaited, _START_S)

    # The camera waits for the stages once it is at work; those that listen are to get its very first message.
    first = awaited if row.name != CAMERA else tuple(name for name in awaited if name.rpartition("/")[2] not in STAGES)

    record = None if options.record is None else with_start(options.record)
    launch = Launch(bus, record, options.recording, plans, wait_until_ready)
    # A recorder is one for all.
    those = each[:1] if row.name == RECORDER else each
    with ExitStack() as closing, StopSignals() as signals, suppress(Interrupted):
        closing.callback(bus.close)
        handlers = [(make(parts, launch), parts.settings.address) for parts in those]
        with ExitStack() as unused:
            # A recorder has begun its file already.
            for handler, _ in handlers:
                unused.callback(handler.stop)
            with signals.raising():
                way.wait(bus, _START_S)
                wait_for(bus, address, first, _START_S)
            unused.pop_all()
        run_nodes(handlers, bus, signals.stop)


def _served(options: Options, row: Process) -> list[tuple[Plan, Field | None]]:
    """The plans that the process serves, each with its field if it needs that."""
    share = None if options.share is None else Share.parse(options.share)
    if share is not None and (row.serves != "run" or row.name == RECORDER or options.pipelines is None):
        several = ", ".join(one.name for one in GRAPH if one.serves == "run" and one.name in STAGES)
        raise UsageError(f"--share is of the pipelines that --pipelines FILE lists, for {several}")
    if options.pipelines is None:
        return [planned(options, row)]
    those = [one.read() for one in pipelines_of(options.pipelines) if row.name in one.processes]
    if not those:
        raise UsageError(f"{options.pipelines}: lists no pipeline that has a process {row.name}")
    if share is not None:
        those = share.take(those)
    return [planned(replace(options, settings=settings, field=field), row) for settings, field in those]


def _parts(plan: Plan, field: Field | None, threads: int, row: Process) -> Parts:
    parts = Parts(plan, threads)
    if field is not None:
        parts.field = field
    if plan.field is not None and row.renders and plan.settings.backend == "numba":
        compile_kernels(plan.field, plan.settings.refinement.needs_jacobian)
    return parts


def _passed(plan: Plan) -> tuple[str, ...]:
    """What a camera's frames pass, of every object that it serves."""
    names = [row.name for row in rows_of(plan, recorded=False) if row.name in AT_WORK]
    here, objects = plan.settings.address, plan.settings.camera.objects
    return tuple(f"{object}/{here.camera}/{name}" for object in objects or (here.object,) for name in names)


def _plans_by_field(options: Options, row: Process) -> bool:
    """Whether this process must know the field: for its own work, to record what was decided, or whom to wait for."""
    return row.needs_field or row.name == RECORDER or (row.name == CAMERA and options.wait_for is None)


def planned(options: Options, row: Process) -> tuple[Plan, Field | None]:
    """The plan of a process, and the field, which only a process that needs it reads: that takes half a second."""
    settings, path = options.settings, options.field
    if path is None or not _plans_by_field(options, row):
        return resolve(settings, None, path), None
    from fieldpose.stages.nerf.training_views import training_views

    field = field_of(path)
    return resolve(settings, training_views(field), path), field


def _tell(plan: Plan, row: Process) -> None:
    """Say what was decided on this host, which must be what others decide: they need the same settings."""
    stage_logger(row.name).info("plan", **{name.replace(" ", "_"): what for name, what in plan.notes.items()})
