"""Addresses of the hub and of the processes around it."""

from __future__ import annotations

import errno
import ipaddress
import re
import socket

from fieldpose.errors import TransportError

_TCP = re.compile(r"(?:tcp|tls|ws|wss)/(?P<host>[\w.:\[\]-]+):(?P<port>\d+)")
_THIS_MACHINE = "127.0.0.1:0"
_EVERYWHERE = "0.0.0.0:0"


def free_port() -> int:
    """A port of the loopback interface that nobody listens on now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def check_free(listen: str | None) -> None:
    """Raise TransportError where another program listens already; what is no address the hub will tell."""
    found = None if listen is None else _TCP.fullmatch(listen)
    if found is None:
        return
    host = found["host"].strip("[]")
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
        # As the hub does; else a port would count as used for a minute after the last one.
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, int(found["port"])))
        except (OSError, OverflowError) as error:
            reason = "the port is in use" if getattr(error, "errno", 0) == errno.EADDRINUSE else str(error)
            raise TransportError(f"cannot listen on {listen}: {reason}; choose another with --listen") from error


def peer_address(hub: str) -> str:
    """Where a process listens for the others: on this machine alone if the hub is on it, else for every host."""
    if _TCP.fullmatch(hub) is None:
        return f"tcp/{_THIS_MACHINE}"
    scheme = "tls" if hub.startswith("tls/") else "tcp"
    return f"{scheme}/{_THIS_MACHINE if is_local(hub) else _EVERYWHERE}"


def is_local(endpoint: str) -> bool:
    """Whether an address can be reached from this machine alone."""
    found = _TCP.fullmatch(endpoint)
    return found is not None and _is_this_machine(found["host"])


def with_scheme(endpoint: str, scheme: str) -> str:
    """The same host and port by another protocol."""
    found = _TCP.fullmatch(endpoint)
    return endpoint if found is None else f"{scheme}/{found['host']}:{found['port']}"


def host_of(endpoint: str) -> str:
    """The host of an address. Raises TransportError for what is none."""
    return _parts(endpoint)["host"].strip("[]")


def port_of(endpoint: str) -> int:
    """The port of an address. Raises TransportError for what is none."""
    return int(_parts(endpoint)["port"])


def _parts(endpoint: str) -> re.Match[str]:
    found = _TCP.fullmatch(endpoint)
    if found is None:
        raise TransportError(f"{endpoint!r} is no address of a hub; expected for instance tcp/127.0.0.1:7447")
    return found


def _is_this_machine(host: str) -> bool:
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost"
