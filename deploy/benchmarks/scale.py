"""What hub, links and processes of one host carry when cameras become more, without the work of the stages."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import psutil

from fieldpose.bus.codec import encode
from fieldpose.bus.messages import Stats
from fieldpose.bus.ports import Inbox
from fieldpose.bus.reading import read_recording
from fieldpose.bus.topics import ALL, STATS, Address
from fieldpose.bus.transport import ZenohBus, wait_for
from fieldpose.deploy.benchmarks import machine
from fieldpose.deploy.benchmarks.scale_player import Part, Told
from fieldpose.deploy.graph import GRAPH, OBSERVER, RECORDER, Process
from fieldpose.deploy.processes.endpoints import free_port
from fieldpose.deploy.processes.forking import FIELDPOSE
from fieldpose.deploy.processes.lifeline import PARENT
from fieldpose.deploy.processes.sessions import end

_PLAY = "import sys; from fieldpose.deploy.benchmarks.scale_player import play; play(sys.argv[1])"
_READY_S, _END_S, _MORE_S = 60.0, 30.0, 10.0
_CAPACITY = 4096


@dataclass(frozen=True)
class Flow:
    """A topic of one pipeline: messages and bytes a second, and how many processes read each message."""

    per_s: float
    bytes_per_s: float
    readers: int


def flows(recording: Path, seconds: float) -> dict[str, Flow]:
    """By topic what one pipeline has sent in the first seconds of a recording."""
    count, size = dict.fromkeys(ALL, 0), dict.fromkeys(ALL, 0)
    began: int | None = None
    for recorded in read_recording(recording):
        began = recorded.log_time_ns if began is None else began
        if recorded.log_time_ns - began < seconds * 1e9:
            count[recorded.topic] += 1
            size[recorded.topic] += len(encode(recorded.message))
    played = _played(recording)
    return {
        topic.name: Flow(
            count[topic] / seconds, size[topic] / seconds, sum(topic in row.reads for row in played)
        ) for topic in ALL if count[topic]
    }  # fmt: skip


def measure(recording: Path, cameras: Sequence[int], seconds: float, report: Callable[[str], None]) -> dict[str, Any]:
    """Everything that `fieldpose bench scale` prints, as its JSON. Raises TransportError and RecordingError."""
    load, flowing = os.getloadavg()[0], flows(recording, seconds)
    by_cameras = {}
    for count in cameras:
        report(f"{count} cameras")
        by_cameras[str(count)] = _measured(recording, count, seconds, flowing)
    return {
        "machine": machine.describe(), "load_before": load, "seconds": seconds,
        "topics": {name: msgspec.to_builtins(flow) for name, flow in flowing.items()}, "cameras": by_cameras,
    }  # fmt: skip


def _measured(recording: Path, count: int, seconds: float, flowing: dict[str, Flow]) -> dict[str, Any]:
    names = tuple(f"camera{number}" for number in range(count))
    with ExitStack() as closing:
        hub = f"tcp/127.0.0.1:{free_port()}"
        serving = closing.enter_context(_ended([*FIELDPOSE, "stage", "hub", "--listen", hub, "--open"]))
        bus = ZenohBus(hub)
        closing.callback(bus.close)
        bus.wait_for_hub(_READY_S)
        inbox = Inbox(bus, Address(camera="*"), [STATS], {STATS: _CAPACITY})
        closing.callback(inbox.close)
        parts = [part for row in _played(recording) for part in _parts(row, recording, names, seconds, hub)]
        running = [closing.enter_context(_ended([sys.executable, "-P", "-c", _PLAY, _json(part)])) for part in parts]
        wanted = [f"object/{camera}/{part.process}" for part in parts for camera in part.cameras]
        wait_for(bus, Address(camera=names[0]), wanted, _READY_S)
        hub_process = psutil.Process(serving.pid)
        before, hub_before = _stats(inbox), machine.cpu_s(hub_process)
        began = time.monotonic()
        bus.hold(Address(camera=names[0]).live(OBSERVER))
        told = [
            msgspec.json.decode(process.communicate(timeout=seconds + _MORE_S + _END_S)[0], type=Told)
            for process in running
        ]
        passed, hub_cpu = time.monotonic() - began, machine.cpu_s(hub_process) - hub_before
        return _figures(parts, told, before, _stats(inbox), passed, flowing, count) | {
            "hub_cpu": hub_cpu / passed, "hub_rss_mb": hub_process.memory_info().rss / 2**20,
        }  # fmt: skip


def _figures(
    parts: Sequence[Part], told: Sequence[Told], before: dict[tuple[str, str], Stats],
    after: dict[tuple[str, str], Stats], passed: float, flowing: dict[str, Flow], count: int,
) -> dict[str, Any]:  # fmt: skip
    cpu: dict[str, float] = {}
    for part in parts:
        at = (part.process, part.cameras[0])
        used = after[at].cpu_s - (before[at].cpu_s if at in before else 0.0)
        cpu[part.process] = cpu.get(part.process, 0.0) + used / passed
    delivered = sum(flow.bytes_per_s * flow.readers for flow in flowing.values())
    oldest = max(told, key=lambda one: one.age_ms[1])
    return {
        "processes": len(parts),
        "links": (len(parts) + 1) * len(parts) // 2,
        "mb_per_s_sent": count * sum(flow.bytes_per_s for flow in flowing.values()) / 1e6,
        "mb_per_s_delivered": count * delivered / 1e6,
        "published": sum(stats.published for stats in after.values()),
        "received": sum(stats.received + stats.skipped for stats in after.values()),
        "gaps": sum(stats.gaps for stats in after.values()),
        "skipped": sum(stats.skipped for stats in after.values()),
        "age_ms": {"p50": oldest.age_ms[0], "p99": oldest.age_ms[1], "max": max(one.age_ms[2] for one in told)},
        "behind_ms": max(one.behind_ms for one in told),
        "cpu": {**cpu, "all": sum(cpu.values())},
    }


def _played(recording: Path) -> list[Process]:
    """The processes that have said something in a recording."""
    senders = {recorded.message.header.source for recorded in read_recording(recording) if recorded.topic is not STATS}
    return [row for row in GRAPH if row.name in senders and row.name != RECORDER]


def _parts(row: Process, recording: Path, names: tuple[str, ...], seconds: float, hub: str) -> list[Part]:
    """As in a run: one process for all cameras, or one each."""
    each = [names] if row.serves == "run" else [(name,) for name in names]
    return [Part(row.name, str(recording), those, seconds, names[0], hub) for those in each]


def _stats(inbox: Inbox) -> dict[tuple[str, str], Stats]:
    """The newest counters of each stage for each camera."""
    found = {}
    for received in inbox.drain():
        at = received.topic.address_of(received.key)
        if at is not None and isinstance(received.message, Stats):
            found[received.message.stage, at.camera] = received.message
    return found


def _json(part: Part) -> str:
    return msgspec.json.encode(part).decode()


@contextmanager
def _ended(command: list[str]) -> Iterator[subprocess.Popen[bytes]]:
    environment = {**os.environ, PARENT: str(os.getpid()), "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, env=environment)
    try:
        yield process
    finally:
        end(process, _END_S)
