"""One process of the pipeline in the foreground."""

from __future__ import annotations

import dataclasses
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from fieldpose.bus.node import Handler, run_node
from fieldpose.bus.transport import LOCAL_HUB, ZenohBus, log_to_stderr, serve_hub, wait_for
from fieldpose.deploy.graph import CAMERA, TABLE, Launch, ProcessSpec, thread_environment, threads_of
from fieldpose.deploy.processes.endpoints import peer_address
from fieldpose.deploy.processes.lifeline import die_with_parent
from fieldpose.deploy.processes.warmup import compile_kernels
from fieldpose.deploy.settings import Settings

_START_S = 300.0
"""Others may be compiling their kernels."""


@dataclass(frozen=True)
class Options:
    """Run one process of the pipeline in the foreground, for another host or a debugger.

    Example: fieldpose stage matching --connect tcp/10.0.0.2:7447 --matching.matcher sift
    """

    name: tyro.conf.Positional[
        Literal[
            "hub", "recorder", "camera", "tracking", "retrieval", "rendering", "matching", "lifting", "pnp",
            "refinement",
        ]
    ]  # fmt: skip
    """Which process."""
    connect: str = LOCAL_HUB
    """Where the hub is."""
    listen: str | None = None
    """Where this process listens: the hub for everybody (default: the address of --connect), any other for the
    processes that it exchanges messages with (default: any port, for this machine alone if the hub is on it)."""
    field: Path | None = None
    """The field, for the processes that need it: tracking, retrieval, rendering, lifting, refinement."""
    record: Path | None = None
    """The recorder's file (.mcap)."""
    threads: int | None = None
    """Threads that it may use (default: by the process table)."""
    wait_for: tuple[str, ...] = ()
    """Processes that must be ready before this one begins; the camera sends nothing before they are."""
    config: Path | None = None
    """TOML or JSON file of settings."""
    settings: Annotated[Settings, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Settings)

    def run(self) -> int:
        """Serve until SIGTERM, Ctrl-C, or the end of the source."""
        supervised = "SUPERVISOR_ENABLED" in os.environ
        if supervised:
            die_with_parent()
        log_to_stderr()
        make_handler = TABLE[self.name].handler
        if make_handler is None:
            serve_hub(self.listen or self.connect)
        else:
            _serve(self, TABLE[self.name], make_handler)
        if supervised:
            # Everything is closed, and Python would take two seconds to take the numeric libraries apart.
            sys.stderr.flush()
            os._exit(0)
        return 0


def _serve(options: Options, spec: ProcessSpec, make_handler: Callable[[Launch], Handler]) -> None:
    threads = options.threads or threads_of(spec, options.settings.tracking.depth)
    os.environ.update(thread_environment(threads))
    address = options.settings.address
    if options.field is not None and spec.renders:
        compile_kernels(options.field, spec.name)
    bus = ZenohBus(options.connect, options.listen or peer_address(options.connect))

    def wait_until_ready() -> None:
        wait_for(bus, address, options.wait_for, _START_S)

    try:
        launch = Launch(bus, options.settings, threads, options.field, options.record, wait_until_ready)
        handler = make_handler(launch)
        bus.wait_for_hub(_START_S)
        if spec.name != CAMERA:
            wait_until_ready()
        run_node(handler, bus, address)
    finally:
        bus.close()
