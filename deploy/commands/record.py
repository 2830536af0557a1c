"""Recording a pipeline that is running already."""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from fieldpose.bus.recorder import Recorder
from fieldpose.bus.signals import StopSignals
from fieldpose.bus.topics import Address
from fieldpose.bus.transport import LOCAL_HUB, ZenohBus
from fieldpose.deploy.processes.endpoints import peer_address
from fieldpose.deploy.reporting.output import check_writable, progress_console

_HUB_S = 5.0


@dataclass(frozen=True)
class Options:
    """Record every message of a pipeline that is running, until Ctrl-C.

    Example: fieldpose record out/now.mcap --connect tcp/127.0.0.1:7447
    """

    recording: tyro.conf.Positional[Path]
    """The file to write (.mcap)."""
    connect: str = LOCAL_HUB
    """Where the hub is."""
    seconds: float | None = None
    """Stop after this time."""
    address: Annotated[Address, tyro.conf.arg(name="")] = dataclasses.field(
        default_factory=lambda: Address(object="*", camera="*")
    )
    """Which pipelines: a part may be "*"."""

    def run(self) -> int:
        """Record, then say what was recorded."""
        check_writable(self.recording)
        bus = ZenohBus(self.connect, peer_address(self.connect))
        try:
            bus.wait_for_hub(_HUB_S)
            recorder = Recorder(bus, self.address, self.recording)
            self._wait(recorder)
            lossless = recorder.close()
        finally:
            bus.close()
        lost = "no message lost" if lossless else "messages are missing, see `fieldpose info`"
        print(f"{self.recording}: {recorder.writer.messages} messages, {lost}")
        return 0

    def _wait(self, recorder: Recorder) -> None:
        end = None if self.seconds is None else time.monotonic() + self.seconds
        with StopSignals() as signals, progress_console().status("recording") as status:
            while not signals.stop.wait(0.2) and (end is None or time.monotonic() < end) and recorder.error is None:
                status.update(f"recording: {recorder.writer.messages} messages, Ctrl-C ends it")
