"""Recording a pipeline that is running already, and asking a recorder for what came last."""

from __future__ import annotations

import dataclasses
import time
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from fieldpose.bus.control import ask_stage
from fieldpose.bus.recorder import NAME, Recorder
from fieldpose.bus.requests import SaveSnapshot
from fieldpose.bus.signals import StopSignals
from fieldpose.bus.topics import Address
from fieldpose.bus.transport import LOCAL_HUB, ZenohBus
from fieldpose.deploy.access.joining import Entry, joined
from fieldpose.deploy.access.roles import OPERATOR
from fieldpose.deploy.graph import RECORDER
from fieldpose.deploy.recording_options import RecordingOptions, seconds_of
from fieldpose.deploy.reporting.output import check_writable, progress_console
from fieldpose.errors import RefusedError, UsageError

_BESIDE = "beside"
_HUB_S = 5.0
_SAVED_S = 60.0
"""A snapshot may have hundreds of megabytes."""


@dataclass(frozen=True)
class Options:
    """Record every message of a pipeline that is running, until Ctrl-C; or keep the last of them, and write it when
    tracking is lost or when it is asked for.

    Example: fieldpose record out/now.mcap --connect tcp/127.0.0.1:7447

    Example: fieldpose record --snapshots out/lost --ring 30s

    Example: fieldpose record --snapshot 10s

    The last asks the recorder of the pipeline, be it this command with --snapshots or `fieldpose run` with
    --record.snapshots, to write what came in the last 10 seconds. No file is ever replaced.
    """

    recording: tyro.conf.Positional[Path | None] = None
    """The file to write (.mcap)."""
    connect: str = LOCAL_HUB
    """Where the hub is."""
    seconds: float | None = None
    """Stop after this time."""
    snapshot: str | None = None
    """Ask for what came in this time, as 10s, and record nothing."""
    options: Annotated[RecordingOptions, tyro.conf.arg(name="")] = dataclasses.field(default_factory=RecordingOptions)
    entry: Annotated[Entry, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Entry)
    address: Annotated[Address, tyro.conf.arg(name="")] = dataclasses.field(
        default_factory=lambda: Address(object="*", camera="*")
    )
    """Which pipelines: a part may be "*"."""

    def run(self) -> int:
        """Record, then say what was recorded; or ask, and say what was answered."""
        if self.snapshot is not None:
            return self._ask(seconds_of(self.snapshot, "snapshot"))
        if self.recording is None and self.options.snapshots is None:
            raise UsageError("nothing to do: give a file to record into, --snapshots DIR, or --snapshot 10s")
        one = "*" not in (self.address.object, self.address.camera)
        self.options.check(self.recording, pipelines=1 if one else 0)
        check_writable(*self.options.files(self.recording))
        with joined(self.connect, self.entry, (RECORDER,), _HUB_S) as bus:
            recorder = Recorder(
                bus, self.address, self.options.store(self.recording, self.address), self.options.keep()
            )
            with self._announced(bus):
                self._wait(recorder)
            lossless = recorder.close()
        self._tell(recorder, lossless)
        return 0

    def _announced(self, bus: ZenohBus) -> AbstractContextManager[object]:
        """Tell pages that there is one to ask for snapshots, under a name that is no pipeline's own recorder."""
        if self.options.snapshots is None:
            return nullcontext()
        return closing(bus.hold(Address(self.address.site, _BESIDE, _BESIDE).live(RECORDER)))

    def _tell(self, recorder: Recorder, lossless: bool) -> None:
        if self.recording is not None:
            lost = "no message lost" if lossless else "messages are missing, see `fieldpose info`"
            print(f"{self.recording}: {recorder.messages} messages, {lost}")
        for path in recorder.snapshots.saved if recorder.snapshots is not None else ():
            print(f"{path}: a snapshot")

    def _wait(self, recorder: Recorder) -> None:
        end = None if self.seconds is None else time.monotonic() + self.seconds
        with StopSignals() as signals, progress_console().status("recording") as status:
            while not signals.stop.wait(0.2) and (end is None or time.monotonic() < end):
                if recorder.ended:
                    return
                written = "" if self.recording is None else f"{recorder.messages} messages, "
                status.update(f"recording: {written}Ctrl-C ends it")

    def _ask(self, seconds: float) -> int:
        if self.recording is not None or self.options != RecordingOptions():
            raise UsageError("--snapshot asks a recorder that is running; leave out what tells how to record")
        with joined(self.connect, self.entry, (OPERATOR,), _HUB_S) as bus:
            bus.settle(_HUB_S)
            saved, refusals = ask_stage(bus, self.address, NAME, SaveSnapshot(seconds=seconds), _SAVED_S)
        for answer in saved.values():
            print(f"{answer.path}: {answer.messages} messages of the last {answer.seconds:.1f} s")
        if refusals:
            raise RefusedError("; ".join(refusals))
        return 0
