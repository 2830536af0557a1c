from __future__ import annotations

import os
import socket
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fieldpose.bus.transport import Bus, MemoryBus, ZenohBus

ROOT = Path(__file__).parents[2]

Spawn = Callable[..., "subprocess.Popen[str]"]

HUB = "import sys; from fieldpose.bus.transport import serve_hub; serve_hub(sys.argv[1])"


class Processes:
    """Starts Python programs given as text and ends what is still running at the end."""

    def __init__(self) -> None:
        self._started: list[subprocess.Popen[str]] = []

    def __call__(self, program: str, *arguments: str) -> subprocess.Popen[str]:
        environment = {**os.environ, "PYTHONPATH": f"{ROOT}:{ROOT / 'tests'}", "OMP_NUM_THREADS": "1"}
        command = [sys.executable, "-c", textwrap.dedent(program), *arguments]
        pipe = subprocess.PIPE
        process = subprocess.Popen(command, env=environment, stdout=pipe, stderr=pipe, text=True, cwd="/")
        self._started.append(process)
        return process

    def close(self) -> None:
        for process in self._started:
            if process.poll() is None:
                process.kill()
            process.communicate()


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@pytest.fixture
def spawn() -> Iterator[Processes]:
    processes = Processes()
    yield processes
    processes.close()


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@pytest.fixture(scope="session")
def hub() -> Iterator[str]:
    """The endpoint of a hub in a process of its own."""
    processes = Processes()
    address = free_endpoint()
    processes(HUB, address)
    probe = ZenohBus(address)
    probe.wait_for_hub(20.0)
    probe.close()
    yield address
    processes.close()


@pytest.fixture
def connect() -> Iterator[Callable[[str], ZenohBus]]:
    """Opens sessions that are closed at the end, also that of a failed test."""
    opened: list[ZenohBus] = []

    def session(address: str) -> ZenohBus:
        opened.append(ZenohBus(address))
        return opened[-1]

    yield session
    for bus in opened:
        bus.close()


@pytest.fixture(params=["memory", "zenoh"])
def sessions(request: pytest.FixtureRequest) -> Iterator[tuple[Bus, Bus]]:
    """Two sessions of one bus."""
    if request.param == "memory":
        first: Bus = MemoryBus()
        second: Bus = MemoryBus(first)
    else:
        address = request.getfixturevalue("hub")
        first, second = ZenohBus(address), ZenohBus(address)
        first.wait_for_hub(5.0)
        second.wait_for_hub(5.0)
    yield first, second
    second.close()
    first.close()
