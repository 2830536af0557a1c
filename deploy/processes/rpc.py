"""Calls to supervisord over its socket, none of which waits for ever."""

from __future__ import annotations

import socket
from pathlib import Path

from supervisor.xmlrpc import SupervisorTransport, UnixStreamHTTPConnection


class Transport(SupervisorTransport):
    """supervisord's own over a Unix socket; a call raises TimeoutError where it is not answered in time."""

    def __init__(self, path: Path, timeout_s: float) -> None:
        super().__init__(None, None, f"unix://{path}")
        self._get_connection = lambda: _Connection(path, timeout_s)


class _Connection(UnixStreamHTTPConnection):
    def __init__(self, path: Path, timeout_s: float) -> None:
        super().__init__("localhost")
        self._path, self._timeout_s = path, timeout_s

    def connect(self) -> None:
        self.sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.sock.settimeout(self._timeout_s)
        self.sock.connect(str(self._path))
