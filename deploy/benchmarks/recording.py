"""Whether the recorder keeps up with a pipeline at full rate: what is lost, and what it takes."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import psutil

from fieldpose.bus.reading import SourceInfo, sources_in
from fieldpose.bus.recorder import NAME
from fieldpose.bus.topics import Address, topic_of
from fieldpose.bus.transport import wait_for
from fieldpose.deploy.benchmarks import echo, machine
from fieldpose.deploy.benchmarks.load import SENDER, Sent
from fieldpose.deploy.processes.forking import FIELDPOSE
from fieldpose.deploy.processes.lifeline import PARENT
from fieldpose.deploy.recording_options import recorded_files
from fieldpose.errors import ProcessError, RecordingError

_SEND = "import sys; from fieldpose.deploy.benchmarks.load import serve; serve(*sys.argv[1:])"
_START_S, _END_S, _LOOK_S = 60.0, 60.0, 0.25
_HIGHEST = re.compile(r"^VmHWM:\s+(\d+) kB$", re.MULTILINE)
Report = Callable[[str], None]


def measure(
    seconds: float, rate_hz: float, size: tuple[int, int], split: str, folder: Path, report: Report
) -> dict[str, Any]:  # fmt: skip
    """Everything that `fieldpose bench record` prints, as its JSON.

    Parts of the recording are counted and removed as soon as they are finished, so that the disk needs room for
    few.
    Raises TransportError, ProcessError and RecordingError.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="bench-record-", dir=folder) as out, echo.hub() as hub:
        record = Path(out) / "bench.mcap"
        account = _Account(record)
        with _process(
            "stage", NAME, "--record", record, "--record.split", split, "--connect", hub, "--open"
        ) as recorder:
            _wait_for_recorder(hub, recorder)
            watched = psutil.Process(recorder.pid)
            cpu_s, began = machine.cpu_s(watched), time.monotonic()
            before_mb = watched.memory_info().rss / 2**20
            sent, rss_mb = _send(hub, (seconds, rate_hz, *size), watched, account, report)
            cpu_s, wall_s = machine.cpu_s(watched) - cpu_s, time.monotonic() - began
            highest_mb = _highest_mb(recorder.pid)
            recorder.terminate()
            _, errors = recorder.communicate(timeout=_END_S)
            if recorder.returncode:
                raise ProcessError(f"the recorder has failed: {errors.decode().splitlines()[-1]}")
            account.take()
    return {
        "machine": machine.describe(),
        "seconds": sent.seconds,
        "behind_s": sent.behind_s,
        **account.figures(sent),
        "cpu_share": cpu_s / wall_s,
        "rss_mb": {"before": before_mb, "highest": highest_mb, **rss_mb},
    }


class _Account:
    """What the finished parts of a recording hold, by their own counts."""

    def __init__(self, record: Path) -> None:
        self._record, self._sources = record, list[SourceInfo]()
        self._parts = self._bytes = 0

    def take(self) -> None:
        """Count the parts that are finished, and remove them."""
        for path in recorded_files(self._record, split=True):
            self._sources += sources_in(path)
            self._parts += 1
            self._bytes += path.stat().st_size
            path.unlink()

    def figures(self, sent: Sent) -> dict[str, Any]:
        by_topic = Counter[str]()
        for source in self._sources:
            topic = topic_of(source.key)
            if source.source == SENDER and topic is not None:
                by_topic[topic.name] += source.written
        lost = {name: count - by_topic[name] for name, count in sent.by_topic.items()}
        return {
            "sent": sum(sent.by_topic.values()),
            "written": sum(by_topic.values()),
            "lost": sum(lost.values()),
            "lost_by_topic": {name: count for name, count in lost.items() if count},
            "missing_by_sequence": sum(source.missing for source in self._sources),
            "unwritten": sum(source.received - source.written for source in self._sources),
            "parts": self._parts,
            "mb_per_s": self._bytes / 1e6 / sent.seconds,
        }


def _send(
    hub: str, load: tuple[float, float, int, int], recorder: psutil.Process, account: _Account, report: Report
) -> tuple[Sent, dict[str, float | None]]:
    """What was sent, and the recorder's memory after a tenth of the time and in the end."""
    command = [sys.executable, "-P", "-c", _SEND, hub, *map(str, load)]
    rss: list[tuple[float, float]] = []
    with _started(command) as sender:
        began = time.monotonic()
        while sender.poll() is None:
            account.take()
            rss.append((time.monotonic() - began, recorder.memory_info().rss / 2**20))
            report(f"{rss[-1][0]:.0f} of {load[0]:.0f} s, {rss[-1][1]:.0f} MB of memory")
            time.sleep(_LOOK_S)
        told, errors = sender.communicate()
        if sender.returncode:
            raise ProcessError(f"the sender has failed: {errors.decode().splitlines()[-1]}")
    early = [mb for at, mb in rss if at <= load[0] / 10]
    return msgspec.json.decode(told, type=Sent), {"after_a_tenth": early[-1] if early else None, "end": rss[-1][1]}


def _wait_for_recorder(hub: str, recorder: subprocess.Popen[bytes]) -> None:
    with echo.session(hub) as bus:
        try:
            wait_for(bus, Address(), [NAME], _START_S)
        except Exception:
            if recorder.poll() is not None and recorder.stderr is not None:
                raise RecordingError(recorder.stderr.read().decode().splitlines()[-1]) from None
            raise


def _process(*arguments: object) -> Any:
    return _started([*FIELDPOSE, *map(str, arguments)])


@contextmanager
def _started(command: list[str]) -> Iterator[subprocess.Popen[bytes]]:
    """A process that ends with the context, and with this process however that ends."""
    pipe, environment = subprocess.PIPE, {**os.environ, PARENT: str(os.getpid()), "SUPERVISOR_ENABLED": "1"}
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, env=environment) as process:
        try:
            yield process
        finally:
            if process.poll() is None:
                process.kill()


def _highest_mb(pid: int) -> float | None:
    """The most memory that a process has had; None where the system does not tell (Linux alone does)."""
    try:
        found = _HIGHEST.search(Path(f"/proc/{pid}/status").read_text(encoding="ascii"))
    except OSError:
        return None
    return int(found[1]) / 1024 if found else None
