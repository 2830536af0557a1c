"""Files by which the processes of a pipeline are started on other hosts."""

from __future__ import annotations

import dataclasses
import re
import shlex
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Literal

import tyro

from fieldpose.bus.transport import checked_endpoint
from fieldpose.deploy.hosts import compose, kubernetes, systemd
from fieldpose.deploy.hosts.carried import Carried
from fieldpose.deploy.hosts.services import CONFIG, FIELDS, Site, Wishes, services_of
from fieldpose.deploy.hosts.writing import write_all
from fieldpose.deploy.recording_options import RecordingOptions
from fieldpose.deploy.rig import planned_rig, read_rig
from fieldpose.deploy.settings import Settings, differing
from fieldpose.errors import UsageError

Kind = Literal["compose", "kubernetes", "systemd"]
_MOST_CORES = 1024
_OF_ONE_KIND: dict[str, Kind] = {"executable": "systemd", "namespace": "kubernetes"}
_LABEL = re.compile(r"[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?")


@dataclass(frozen=True)
class Options:
    """Write the files that start the processes of a pipeline, or of several, on other hosts, from the graph that `run`
    starts them from.

    Example: fieldpose deploy compose out/site out/mine.safetensors --source left=camera:0 --source right=camera:2
    --shares rendering=2 matching=2

    Every process is a service of its own with its own role's certificate (`fieldpose certs`), as no superuser, on files
    it cannot write. What each host is then given, and which services it starts, stands in docs/scaling.md.
    """

    kind: tyro.conf.Positional[Kind]
    """For what: Docker Compose, Kubernetes, or systemd."""
    out: tyro.conf.Positional[Path]
    """The folder to write into."""
    field: Annotated[
        tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="FIELD ...", help_behavior_hint="")
    ] = ()
    """The field (.safetensors) of the object or scene; of several objects FILE or NAME=FILE each."""
    source: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """As of `fieldpose run`, once for each camera; files by the whole path that they have on the camera's host."""
    shares: tuple[str, ...] = ()
    """How many processes a stage has that share the pipelines, as rendering=2."""
    join: tuple[str, ...] = ()
    """Hubs of other groups of hosts, that this group's hub passes messages to and from."""
    cores: int = 4
    """The cores of a host, which threads are counted from."""
    image: str = dataclasses.field(default_factory=lambda: f"fieldpose:{version('fieldpose')}")
    """The image of the containers, as built from the Dockerfile."""
    executable: str = "/opt/fieldpose/bin/fieldpose"
    """systemd: where `fieldpose` is on the hosts."""
    shared_memory: bool = False
    """compose: containers of one host exchange images through its /dev/shm."""
    namespace: str = "fieldpose"
    """kubernetes: the namespace of everything."""
    record: Path | None = None
    """The recorder's file, a path below /var/lib/fieldpose, or a name in it."""
    recording: Annotated[RecordingOptions, tyro.conf.arg(name="record")] = dataclasses.field(
        default_factory=RecordingOptions
    )
    again: bool = False
    """Write anew what is there already."""
    config: Path | None = None
    """TOML or JSON file of settings, which may tell of several objects and cameras."""
    settings: Annotated[Settings, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Settings)

    @staticmethod
    def settings_of(config: Path) -> Settings:
        """The settings of a configuration file that may tell of several objects and cameras."""
        return read_rig(config)[0]

    def run(self) -> int:
        """Write them, and say what goes where."""
        site = self.site()
        gone = write_all(self.out, _WRITERS[self.kind](site, self.executable), self.again)
        if gone:
            print(f"removed here, and to be disabled and removed on the hosts: {', '.join(gone)}")
        for line in _SAID[self.kind](self.out, site):
            print(line)
        return 0

    def site(self) -> Site:
        """What is written. Raises UsageError, ConfigError and FieldFileError."""
        if not 1 <= self.cores <= _MOST_CORES:
            raise UsageError(f"--cores {self.cores}: expected 1 to {_MOST_CORES}")
        for name, kind in _OF_ONE_KIND.items():
            if self.kind != kind and getattr(self, name) != _default(name):
                raise UsageError(f"--{name} is of {kind} alone, and {self.kind} was asked for; leave it out")
        if not self.executable.startswith("/"):
            raise UsageError(
                f"--executable {self.executable}: expected the whole path that it has on the hosts, from /"
            )
        if not _LABEL.fullmatch(self.namespace):
            raise UsageError(f"--namespace {self.namespace}: expected small letters, digits and hyphens, at most 63")
        for other in self.join:
            checked_endpoint(other)
        plans = planned_rig(self.settings, read_rig(self.config)[1], self.field, self.source)
        self.recording.check_form(self.record, len(plans))
        shares = dict(_share(text) for text in self.shares)
        wishes = Wishes(self.cores, shares, self.join, self.record, self.recording)
        carried = Carried(CONFIG, FIELDS)
        services = services_of(plans, wishes, carried)
        made_by = self._made_by()
        site = Site(services, carried.files, carried.fields, self.image, self.shared_memory, made_by, self.namespace)
        site.check_lines()
        return site

    def _made_by(self) -> str:
        words = ["fieldpose", "deploy", self.kind, "DIR", *self.field]
        for name in ("source", "shares", "join"):
            given = getattr(self, name)
            apart = name == "source"
            words += (
                [word for one in given for word in ("--source", one)] if apart else [f"--{name}", *given] * bool(given)
            )
        for name in ("cores", "image", "executable", "namespace", "record", "config"):
            if getattr(self, name) != _default(name):
                words += [f"--{name}", str(getattr(self, name))]
        words += ["--shared-memory"] * self.shared_memory
        words += self._recording_words()
        if self.config is None:
            words += [word for name, value in differing(self.settings).items() for word in (f"--{name}", value)]
        return shlex.join(words)

    def _recording_words(self) -> list[str]:
        plain, words = RecordingOptions().arguments("record."), self.recording.arguments("record.")
        pairs = [words[i : i + 2] for i in range(0, len(words), 2)]
        usual = [plain[i : i + 2] for i in range(0, len(plain), 2)]
        return [word for pair in pairs if pair not in usual for word in pair]


def _default(name: str) -> object:
    found = next(field for field in dataclasses.fields(Options) if field.name == name)
    return found.default if found.default_factory is dataclasses.MISSING else found.default_factory()


def _share(text: str) -> tuple[str, int]:
    name, _, number = text.partition("=")
    if not number.isdigit():
        raise UsageError(f"--shares {text!r}: expected STAGE=NUMBER, as rendering=2")
    return name, int(number)


_WRITERS: dict[Kind, Callable[[Site, str], dict[str, bytes]]] = {
    "compose": lambda site, executable: compose.files(site),
    "kubernetes": lambda site, executable: kubernetes.files(site),
    "systemd": systemd.files,
}


def _fields(site: Site, where: str) -> str:
    return f"{', '.join(map(str, site.fields.values()))}: to {where}"


def _for_compose(out: Path, site: Site) -> list[str]:
    names = " ".join(service.name for service in site.services)
    return [
        f"{out}: compose.yaml and config/, to every host",
        _fields(site, "fields/ beside it on the hosts of those that read it"),
        f"fieldpose certs {out}/certs --hosts …: each host needs ca.pem and the files of the roles that it runs, of the"
        " user that the containers are: 1000, or the UID:GID in FIELDPOSE_USER",
        f"then, on each host, with those that it is to run: FIELDPOSE_HUB=tls/HOST:7447 docker compose up"
        f" --remove-orphans {names}",
    ]


def _for_kubernetes(out: Path, site: Site) -> list[str]:
    films = " ".join(service.name for service in site.services if service.reads is not None)
    return [
        f"fieldpose certs {out}/certs --hosts hub: become secrets, a role each",
        f"kubectl apply -k {out}; what a change has left, as after other --shares, goes by kubectl delete deployment"
        " NAME: two that serve one pipeline answer each message twice",
        *([f"a camera of files is a job, to be deleted before it is applied again: {films}"] if films else []),
        _fields(site, "the volume of the claim fields"),
    ]


def _for_systemd(out: Path, site: Site) -> list[str]:
    return [
        f"{out}: *.service and *.target to /etc/systemd/system, fieldpose-sysusers.conf to /etc/sysusers.d,"
        " config/* and hub.env to /etc/fieldpose, on every host; in hub.env stands where the hub is",
        _fields(site, FIELDS),
        f"fieldpose certs certs --hosts …: of the roles that a host runs, to {systemd.CERTIFICATES}, of root alone",
        f"then systemd-sysusers; systemctl daemon-reload; systemctl enable {systemd.TARGET} and those that the host"
        f" is to run; systemctl start {systemd.TARGET}",
    ]


_SAID: dict[Kind, Callable[[Path, Site], list[str]]] = {
    "compose": _for_compose,
    "kubernetes": _for_kubernetes,
    "systemd": _for_systemd,
}
