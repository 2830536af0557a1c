"""A running pipeline in Foxglove, live."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from fieldpose.bus.signals import StopSignals
from fieldpose.bus.topics import Address
from fieldpose.bus.transport import LOCAL_HUB
from fieldpose.deploy.access.joining import Entry, join
from fieldpose.deploy.access.roles import VIEWER
from fieldpose.deploy.foxglove.extra import check_extra
from fieldpose.deploy.foxglove.layouts import layout
from fieldpose.deploy.reporting.output import check_writable, write_bytes
from fieldpose.errors import UsageError

if TYPE_CHECKING:
    from fieldpose.deploy.foxglove.serving import Bridge

_HUB_S = 5.0


@dataclass(frozen=True)
class Foxglove:
    """Show a pipeline that is running, live in Foxglove or Lichtblick, until Ctrl-C.

    Example: fieldpose bridge foxglove --connect tcp/127.0.0.1:7447

    Open a Foxglove WebSocket connection to the address that is printed. What nobody looks at is not converted; pictures
    come ten times a second at most. Whoever reaches the port sees all of it, so that it listens on this machine alone
    unless --host says otherwise. It needs the extra: pip install 'fieldpose[foxglove]'.
    """

    connect: str = LOCAL_HUB
    """Where the pipeline's hub is; `fieldpose run` says it when it starts."""
    host: str = "127.0.0.1"
    """The interface to listen on; 0.0.0.0 for all."""
    port: int = 8765
    """The port to listen on; 0 for a free one."""
    layout: Path | None = None
    """Write the layout that shows everything into this file (.json), to be imported in Foxglove. What it draws has the
    right size for cameras about 4 units away; the layout that `fieldpose export` writes fits its recording."""
    entry: Annotated[Entry, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Entry)
    address: Annotated[Address, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Address)
    """Which pipeline."""

    def run(self) -> int:
        """Serve, then say how much it was."""
        self._check()
        from fieldpose.deploy.foxglove.serving import Bridge, Server

        bus = join(self.connect, self.entry, (VIEWER,), _HUB_S)
        try:
            with Server(self.host, self.port, f"fieldpose {self.address.pair}") as server, StopSignals() as signals:
                if self.layout is not None:
                    self._write_layout(self.layout)
                bridge = Bridge(bus, self.address, server)
                print(f"serving {self.address.pair} on ws://{self.host}:{server.port}, Ctrl-C ends it", flush=True)
                bridge.run(signals.stop)
        finally:
            bus.close()
        print(_in_words(bridge))
        return 0

    def _check(self) -> None:
        check_extra()
        if not 0 <= self.port < 2**16:
            raise UsageError(f"--port {self.port}: must be from 0 to 65535")
        if "*" in (self.address.site, self.address.object, self.address.camera):
            raise UsageError("one pipeline can be shown, so that no part of its address may be '*'; start one for each")
        check_writable(self.layout)

    def _write_layout(self, path: Path) -> None:
        write_bytes(path, layout())
        print(f"{path}: a layout")


def _in_words(bridge: Bridge) -> str:
    unreadable = f", {bridge.unreadable} images could not be shown" if bridge.unreadable else ""
    return f"{bridge.messages} messages read{unreadable}"
