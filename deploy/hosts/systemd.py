"""A site as units of systemd, of which each host enables those that it is to run."""

from __future__ import annotations

import re

from fieldpose.deploy.graph import HUB
from fieldpose.deploy.hosts.services import CACHE, FIELDS, PORT, STATE, Service, Site

CERTIFICATES = "/etc/fieldpose/certs"
_HUB = "${FIELDPOSE_HUB}"
TARGET = "fieldpose.target"
_WORD = re.compile(r"[^\s\"'\\;]+")
_PATH = re.compile(r"[^\s\"'\\:]+")
"""Where a colon parts two paths."""
_HARDENING = """NoNewPrivileges=yes
CapabilityBoundingSet=
AmbientCapabilities=
ProtectSystem=strict
ProtectHome=tmpfs
ProtectClock=yes
ProtectControlGroups=yes
ProtectHostname=yes
ProtectKernelLogs=yes
ProtectKernelModules=yes
ProtectKernelTunables=yes
ProtectProc=invisible
PrivateTmp=yes
LockPersonality=yes
RestrictNamespaces=yes
RestrictRealtime=yes
RestrictSUIDSGID=yes
RestrictAddressFamilies=AF_INET AF_INET6 AF_UNIX AF_NETLINK
SystemCallArchitectures=native
SystemCallFilter=@system-service
SystemCallErrorNumber=EPERM
UMask=0077"""


def files(site: Site, executable: str) -> dict[str, bytes]:
    """The files of a folder, by their names in it. executable: where `fieldpose` is on the hosts."""
    units = {f"{unit_name(service)}": _unit(service, site, executable).encode() for service in site.services}
    return {
        TARGET: f"{site.note}[Unit]\nDescription=fieldpose\n\n[Install]\nWantedBy=multi-user.target\n".encode(),
        **units,
        "fieldpose-sysusers.conf": f'{site.note}u fieldpose - "fieldpose" {STATE}\n'.encode(),
        "hub.env": f"{site.note}FIELDPOSE_HUB=tls/127.0.0.1:{PORT}\n".encode(),
        **{f"config/{name}": content for name, content in site.files.items()},
    }


def unit_name(service: Service) -> str:
    return f"fieldpose-{service.name}.service"


def _unit(service: Service, site: Site, executable: str) -> str:
    environment = "\n".join(f"Environment={name}={value}" for name, value in service.environment.items())
    keys = "\n".join(f"LoadCredential={name}:{CERTIFICATES}/{name}" for name in service.certificates)
    words = service.command(_HUB, "%d", shared_memory=True)
    # In the program itself no variable is expanded.
    command = " \\\n  ".join([_quoted(executable, _PATH), *map(_quoted, words)])
    after = "network-online.target time-sync.target"
    after += "" if service.row.name == HUB else f" fieldpose-{HUB}.service"
    return f"""{site.note}[Unit]
Description=fieldpose {service.name}
PartOf={TARGET}
Wants=network-online.target time-sync.target
After={after}
# However often it ends with an error: a hub that is away, a camera that is not plugged in, a clock that is not set yet.
StartLimitIntervalSec=0

[Service]
Type=exec
EnvironmentFile=/etc/fieldpose/hub.env
{environment}
# Its own role's certificate and key, which no other unit sees.
{keys}
ExecStart={command}
Restart=on-failure
RestartSec=1
TimeoutStopSec={service.stop_s:g}
MemoryMax={service.memory_mb}M
# Shared memory is locked: by a sender its own, by a receiver that of all that it hears.
LimitMEMLOCK=infinity
User=fieldpose
{_given(service)}
{_HARDENING}

[Install]
WantedBy={TARGET}
"""


def _given(service: Service) -> str:
    lines = [f"CacheDirectory={CACHE.rpartition('/')[2]}"]
    if service.writes:
        lines.append(f"StateDirectory={STATE.rpartition('/')[2]}")
    # /dev/shm stays shared; the certificates of others do not.
    lines.append(f"InaccessiblePaths=-{CERTIFICATES}")
    if service.with_fields:
        lines.append(f"ReadOnlyPaths={FIELDS}")
    if service.reads is not None:
        lines.append(f"BindReadOnlyPaths={_quoted(service.reads, _PATH)}")
    if service.device is None:
        return "\n".join([*lines, "PrivateDevices=yes"])
    return "\n".join(
        [*lines, "SupplementaryGroups=video", "DevicePolicy=closed", f"DeviceAllow={_quoted(service.device, _PATH)} rw"]
    )


def _quoted(word: str, plain: re.Pattern[str] = _WORD) -> str:
    """As it stands in a unit: in quotes unless it is plain, and without what would be expanded there."""
    # Of the hub's variable and %d just that is wanted.
    if word in (_HUB, "%d"):
        return word
    word = word.replace("%", "%%")
    word = word if plain is _PATH else word.replace("$", "$$")
    if plain.fullmatch(word):
        return word
    escaped = word.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'
