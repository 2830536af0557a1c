"""Addresses of the hub and of the processes around it."""

from __future__ import annotations

import errno
import ipaddress
import re
import socket

from fieldpose.errors import TransportError

_TCP = re.compile(r"(?:tcp|tls|ws|wss)/(?P<host>[\w.:\[\]-]+):(?P<port>\d+)")
_THIS_MACHINE = "tcp/127.0.0.1:0"
_EVERYWHERE = "tcp/0.0.0.0:0"


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
    found = _TCP.fullmatch(hub)
    return _THIS_MACHINE if found is None or _is_this_machine(found["host"]) else _EVERYWHERE


def _is_this_machine(host: str) -> bool:
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost"
