"""The processes of a run as programs: whose each is, its command line, and whom it waits for.

A run of one pipeline names them as the graph does. Of several, most processes serve all, in turn: one for each would be
too many for the bus and for the memory. Those that are there for each have its object and camera in their names.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from fieldpose.bus.topics import Address
from fieldpose.deploy.graph import (
    CAMERA,
    HUB,
    OBSERVER,
    RECORDER,
    STAGES,
    Process,
    rows_of,
    thread_environment,
    threads_of,
)  # fmt: skip
from fieldpose.deploy.plan import Plan
from fieldpose.deploy.processes.forking import FIELDPOSE
from fieldpose.deploy.processes.supervision import Program
from fieldpose.deploy.recording_options import RecordingOptions
from fieldpose.deploy.settings import to_json

_PLAIN = RecordingOptions()
SETTINGS, PROGRESS, PIPELINES = "settings", "camera-progress", "pipelines.json"


@dataclass(frozen=True)
class Member:
    """A process of a run. name: its program's; plans: of the pipelines that it serves."""

    name: str
    row: Process
    plans: tuple[Plan, ...]

    @property
    def at(self) -> tuple[Address, ...]:
        """Where it says that it is ready; a camera and a recorder once for all that they serve."""
        once = self.row.name in (CAMERA, RECORDER)
        return tuple(plan.settings.address for plan in (self.plans[:1] if once else self.plans))


def members(plans: Sequence[Plan], recorded: bool) -> list[Member]:
    """The processes of a run of these plans, the hub among them."""
    served: dict[tuple[str, Process], list[Plan]] = {}
    for plan in plans:
        for row in rows_of(plan, recorded):
            served.setdefault((_name(row, plan, len(plans) > 1), row), []).append(plan)
    return [Member(name, row, _in_order(row, its)) for (name, row), its in served.items()]


def _in_order(row: Process, plans: Sequence[Plan]) -> tuple[Plan, ...]:
    """A camera is of the object first whose true poses it knows: under that one's key it sends them."""
    if row.name != CAMERA:
        return tuple(plans)
    return tuple(sorted(plans, key=lambda plan: plan.settings.address.object != plan.settings.camera.truth_of))


def programs(
    plans: Sequence[Plan],
    folder: Path,
    hub: str,
    record: Path | None,
    recording: RecordingOptions = _PLAIN,
    keys: Path | None = None,
) -> list[Program]:
    """The command line and environment of each process; what they read is left in `folder`.

    keys: the folder of the certificates of a closed bus; an open one has none.
    """
    everyone = members(plans, record is not None or recording.snapshots is not None)
    _write_settings(plans, folder, everyone)
    joins = ("--connect", hub, *(("--open",) if keys is None else ("--tls", str(keys.resolve()))))
    made = [_program(member, everyone, plans, folder, joins) for member in everyone]
    recorder = ([] if record is None else ["--record", str(record.resolve())]) + recording.arguments("record.")
    return [
        replace(program, command=[*program.command, *recorder]) if member.row.name == RECORDER else program
        for member, program in zip(everyone, made, strict=True)
    ]


def preloading(folder: Path) -> tuple[str, ...]:
    """What is called before any process of a run is started, so that all of them share what it loads."""
    return ("fieldpose.deploy.processes.preload:preload", str(folder / PIPELINES))


def _program(
    member: Member, everyone: Sequence[Member], plans: Sequence[Plan], folder: Path, joins: Sequence[str]
) -> Program:  # fmt: skip
    row, plan = member.row, member.plans[0]
    threads = threads_of(row, max(plan.in_flight for plan in member.plans))
    command = [*FIELDPOSE, "stage", row.name, *joins, "--config", str(_settings_file(folder, plan, plans))]
    if plan.field is not None:
        command += ["--field", str(plan.field.resolve())]
    command += ["--threads", str(threads)]
    if row.serves == "run" and row.make is not None and len(plans) > 1:
        command += ["--pipelines", str(folder / PIPELINES)]
    if row.name != HUB:
        command += ["--wait-for", *_awaited(member, everyone, plans)]
    environment = thread_environment(threads)
    return Program(member.name, command, environment, row.stop_s, ends=row.name == CAMERA)


def _awaited(member: Member, everyone: Sequence[Member], plans: Sequence[Plan]) -> list[str]:
    """Who must be ready before it begins: those that listen to everything, and for a camera all that it serves."""
    here = member.plans[0].settings.address
    awaited = [(OBSERVER, plans[0].settings.address)]
    if member.row.name != RECORDER:
        awaited += [(other.row.name, at) for other in everyone if other.row.name == RECORDER for at in other.at]
    if member.row.name == CAMERA:
        stages = [other for other in everyone if other.row.name in STAGES and other.row.name != CAMERA]
        awaited += [(other.row.name, at) for other in stages for at in other.at if at.camera == here.camera]
    return [name if at == here else f"{at.pair}/{name}" for name, at in awaited]


def _write_settings(plans: Sequence[Plan], folder: Path, everyone: Sequence[Member]) -> None:
    listed = []
    for plan in plans:
        camera = plan.settings.camera
        progress = folder / f"{PROGRESS}{_suffix(plan, plans)}.json"
        progress.unlink(missing_ok=True)
        config = _settings_file(folder, plan, plans)
        config.write_bytes(to_json(replace(plan.settings, camera=replace(camera, progress_file=progress))))
        field = None if plan.field is None else str(plan.field.resolve())
        names = [member.row.name for member in everyone if plan in member.plans]
        listed.append({"settings": str(config), "field": field, "processes": names})
    (folder / PIPELINES).write_text(json.dumps({"pipelines": listed}, indent=2) + "\n", encoding="utf-8")


def _settings_file(folder: Path, plan: Plan, plans: Sequence[Plan]) -> Path:
    return folder / f"{SETTINGS}{_suffix(plan, plans)}.json"


def _suffix(plan: Plan, plans: Sequence[Plan]) -> str:
    address = plan.settings.address
    return f"@{address.object}@{address.camera}" if len(plans) > 1 else ""


def _name(row: Process, plan: Plan, several: bool) -> str:
    address = plan.settings.address
    if not several or row.serves == "run":
        return row.name
    return f"{row.name}@{address.camera}" if row.serves == "camera" else f"{row.name}@{address.object}@{address.camera}"
