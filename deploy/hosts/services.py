"""What runs on other hosts: the members of a run as services, each with its command line and what it is to be given."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from fieldpose.bus.access import AUTHORITY
from fieldpose.deploy.graph import BY_NAME, CAMERA, HUB, RECORDER, STAGES, Process, thread_environment, threads_of
from fieldpose.deploy.hosts.carried import Carried
from fieldpose.deploy.plan import Plan
from fieldpose.deploy.processes.programs import PIPELINES, Member, members
from fieldpose.deploy.recording_options import START, RecordingOptions
from fieldpose.deploy.sharing import Share
from fieldpose.errors import UsageError

CONFIG, FIELDS, STATE, CACHE = "/etc/fieldpose", "/srv/fieldpose/fields", "/var/lib/fieldpose", "/var/cache/fieldpose"
"""Where a host or a container has settings and calibrations, fields, what is written, and compiled kernels."""
TLS = "/run/fieldpose/tls"
"""Where a container has the certificate and the key of its role."""
PORT = 7447
EVERYWHERE = f"tls/0.0.0.0:{PORT}"
_NOT_IN_NAMES = re.compile(r"[^a-z0-9]+")
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]")
_MEMORY_MB = 2048
"""Far above what a process uses, for a limit is to save the host from one that has gone wrong."""
_MORE_S = 5.0
_SOURCES_OF_FILES = ("folder", "dataset", "video", "mcap", "bag")


@dataclass(frozen=True)
class Service:
    """A process on whichever host.

    arguments: of `fieldpose`, but for how it joins the hub; device: of a camera; reads: a file or folder of its host
    that its frames come from; writes: whether it keeps recordings; memory_mb: at most.
    """

    name: str
    row: Process
    arguments: tuple[str, ...]
    threads: int
    device: str | None = None
    reads: str | None = None
    writes: bool = False
    memory_mb: int = _MEMORY_MB

    @property
    def environment(self) -> dict[str, str]:
        """Its budget of threads, and where kernels are kept."""
        kept = {} if self.row.name == HUB else {"NUMBA_CACHE_DIR": CACHE, "MPLCONFIGDIR": CACHE}
        return {**thread_environment(self.threads), **kept}

    @property
    def with_fields(self) -> bool:
        """Whether it reads a field's file."""
        return self.row.needs_field or self.row.name in (CAMERA, RECORDER)

    @property
    def certificates(self) -> tuple[str, ...]:
        """The files of a folder of certificates that it needs: its own role's, and no others."""
        return AUTHORITY, f"{self.row.name}.pem", f"{self.row.name}.key"

    @property
    def stop_s(self) -> float:
        """How long it may take to end before it is killed."""
        return self.row.stop_s + _MORE_S

    @property
    def container_device(self) -> str | None:
        """The device that a container is given. Raises UsageError for one that cannot be named to its tools."""
        if self.device is not None and ":" in self.device:
            raise UsageError(f"{self.device}: containers take no device with a colon; see /dev/v4l/by-id, /dev/video*")
        return self.device

    def command(self, hub: str, tls: str, shared_memory: bool) -> list[str]:
        """Its arguments, with the hub's address and the folder of its certificates."""
        if self.row.name == HUB:
            return [*self.arguments, "--tls", tls]
        away = () if shared_memory else ("--no-shared-memory",)
        return [*self.arguments, "--connect", hub, "--tls", tls, *away]


@dataclass(frozen=True)
class Site:
    """Everything that is written down.

    files: the settings, by their names in CONFIG; fields: the files of fields, by their names in FIELDS; made_by: the
    command line that writes all this; namespace: of Kubernetes.
    """

    services: tuple[Service, ...]
    files: Mapping[str, bytes]
    fields: Mapping[str, Path]
    image: str
    shared_memory: bool
    made_by: str
    namespace: str = "fieldpose"

    @property
    def roles(self) -> list[str]:
        """Whose certificates are needed."""
        return list(dict.fromkeys(service.row.name for service in self.services))

    def check_lines(self) -> None:
        """Raise UsageError for what would end a line in the files, and so begin another of its own."""
        words = (word for one in self.services for word in (*one.arguments, one.reads or "", one.device or ""))
        for text in (self.made_by, self.image, *words):
            if _CONTROL.search(text) is not None:
                raise UsageError(f"{text!r}: has a control character, as the end of a line is; rename it")

    @property
    def note(self) -> str:
        """What stands at the head of each file."""
        return f"# Written by `{self.made_by}`: change that and write it anew.\n"


@dataclass(frozen=True)
class Wishes:
    """What is open about a site: cores of each host; shares: how many processes a stage has; join: hubs of others."""

    cores: int = 4
    shares: Mapping[str, int] = field(default_factory=dict)
    join: tuple[str, ...] = ()
    record: Path | None = None
    recording: RecordingOptions = field(default_factory=RecordingOptions)


def services_of(plans: Sequence[Plan], wishes: Wishes, carried: Carried) -> tuple[Service, ...]:
    """A service for each process of a run of these plans, or several of those that share.

    carried: takes what they read in. Raises UsageError.
    """
    recorded = wishes.record is not None or wishes.recording.snapshots is not None
    everyone = members(plans, recorded)
    settings = [carried.settings(plan, len(plans) > 1) for plan in plans]
    fields = [carried.field(plan) for plan in plans]
    if len(plans) > 1:
        listed = [
            {"settings": file, "field": field, "processes": [one.row.name for one in everyone if plan in one.plans]}
            for plan, file, field in zip(plans, settings, fields, strict=True)
        ]
        carried.add(PIPELINES, json.dumps({"pipelines": listed}, indent=2).encode() + b"\n")
    files = dict(zip(map(id, plans), zip(settings, fields, strict=True), strict=True))
    _check_shares(wishes.shares, everyone)
    found = [one for member in everyone for one in _services(member, files[id(member.plans[0])], plans, wishes)]
    for name, times in Counter(service.name for service in found).items():
        if times > 1:
            raise UsageError(f"two processes would be named {name}; name objects and cameras by letters and digits")
    return tuple(found)


def _services(member: Member, files: tuple[str, str], plans: Sequence[Plan], wishes: Wishes) -> list[Service]:
    row = member.row
    name = _NOT_IN_NAMES.sub("-", member.name.lower()).strip("-")
    if row.name == HUB:
        joins = tuple(word for other in wishes.join for word in ("--join", other))
        return [Service(name, row, ("stage", HUB, "--listen", EVERYWHERE, *joins), 1)]
    threads = threads_of(row, max(plan.in_flight for plan in member.plans), wishes.cores)
    several = row.serves == "run" and len(plans) > 1
    settings, path = files
    reads = ("--pipelines", f"{CONFIG}/{PIPELINES}") if several else ("--config", f"{CONFIG}/{settings}")
    arguments = ("stage", row.name, *reads, *(() if several else ("--field", path)), "--threads", str(threads))
    one = Service(name, row, arguments, threads)
    if row.name == RECORDER:
        return [_recording(one, wishes)]
    if row.name == CAMERA:
        kind, _, rest = member.plans[0].settings.camera.source.partition(":")
        device = (f"/dev/video{rest}" if rest.isdigit() else rest) if kind == "camera" else None
        read = _path_of(kind, rest) if kind in _SOURCES_OF_FILES else None
        return [replace(one, device=device, reads=read)]
    of = wishes.shares.get(row.name, 1)
    shares = [Share(number, of) for number in range(1, of + 1)] if of > 1 else []
    return [
        replace(one, name=f"{name}-{share.number}", arguments=(*arguments, "--share", str(share))) for share in shares
    ] or [one]


def _recording(recorder: Service, wishes: Wishes) -> Service:
    kept = () if wishes.record is None else ("--record", str(_at_each_start(_below_state(wishes.record, "--record"))))
    options, needed_mb = wishes.recording, _MEMORY_MB
    if options.snapshots is not None:
        options = replace(options, snapshots=_below_state(options.snapshots, "--record.snapshots"))
        needed_mb += options.most_memory_mb
    arguments = (*recorder.arguments, *kept, *options.arguments("record."))
    return replace(recorder, arguments=arguments, writes=True, memory_mb=needed_mb)


def _below_state(path: Path, option: str) -> Path:
    """Where a service can write. Raises UsageError for a path elsewhere."""
    whole = STATE / path
    if ".." in path.parts or not whole.is_relative_to(STATE) or whole == Path(STATE):
        raise UsageError(f"{option} {path}: services write below {STATE} alone; give a path there, or a name in it")
    return whole


def _at_each_start(record: Path) -> Path:
    # No recording replaces a file, and services are started again after each reboot.
    return record if START in record.name else record.with_stem(record.stem + f"-{START}")


def _path_of(kind: str, rest: str) -> str:
    path = rest.rpartition("#")[0] or rest if kind == "bag" else rest.partition(":")[0] if kind == "dataset" else rest
    if not path.startswith("/"):
        raise UsageError(f"{kind}:{rest}: give the whole path that it has on the camera's host, from / on")
    return path


def _check_shares(shares: Mapping[str, int], everyone: Sequence[Member]) -> None:
    served = {member.row.name: len(member.plans) for member in everyone}
    for name, of in shares.items():
        if name not in BY_NAME or name not in STAGES or BY_NAME[name].serves != "run":
            able = ", ".join(row.name for row in BY_NAME.values() if row.serves == "run" and row.name in STAGES)
            raise UsageError(f"shares: {name} cannot be several; expected one of {able}")
        if not 1 <= of <= served.get(name, 0):
            raise UsageError(f"shares: {name}={of}: there are {served.get(name, 0)} pipelines to share")
