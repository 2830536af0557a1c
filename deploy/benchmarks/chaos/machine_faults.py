"""What can go wrong with that on which processes stand: the link between two hosts is cut, the disk is full.

Both need rights that root has, on Linux. Hosts are network namespaces of this machine.
"""

from __future__ import annotations

import csv
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from fieldpose.bus.messages import TrackingState
from fieldpose.bus.open_recording import unfinished_file
from fieldpose.bus.reading import info
from fieldpose.bus.recovery import recover
from fieldpose.deploy.benchmarks.chaos.events import PAUSE_S, Event, Kind
from fieldpose.deploy.benchmarks.chaos.judging import Verdict, Wrong, back_s
from fieldpose.deploy.benchmarks.chaos.rounds import Played
from fieldpose.deploy.benchmarks.sequences import Sequence as Followed
from fieldpose.deploy.benchmarks.two_hosts import two_hosts
from fieldpose.deploy.processes.forking import FIELDPOSE
from fieldpose.deploy.reporting.results import FrameResult
from fieldpose.errors import FieldposeError

_DISK_MB = 36
"""Of which a recorder keeps 16 free for the end of its file."""
_DISK_FRAMES = 300
_PORT = 7447
_READY_S, _BEFORE_S, _AFTER_S = 120.0, 4.0, 4.0


def missing_rights() -> dict[Kind, str]:
    """What cannot be done here, and why."""
    found = {}
    for kind, tries in ((Kind.CUT, two_hosts), (Kind.FULL, _small_disk)):
        try:
            with tries():
                pass
        except (OSError, subprocess.CalledProcessError) as error:
            said = getattr(error, "stderr", None) or b""
            found[kind] = said.decode(errors="replace").strip() or str(error)
    return found


def cut(source: Path, followed: Followed) -> Played:
    """The camera on one host, everything else on another, and no link between them for PAUSE_S."""
    verdict = Verdict(Event(Kind.CUT), away_s=PAUSE_S)
    with two_hosts() as hosts, tempfile.TemporaryDirectory(prefix="fieldpose-chaos-") as folder:
        rows = Path(folder) / "run.csv"
        hub, keys = f"tls/{hosts.stages_at}:{_PORT}", Path(folder) / "keys"
        written = ("--csv", rows, "--tls", keys)
        addresses = ("--hosts", hosts.stages_at, hosts.camera_at)
        subprocess.run(_command("certs", keys, *addresses), check=True, capture_output=True)
        with ExitStack() as closing:
            run = closing.enter_context(
                hosts.started(hosts.stages, "run", followed.field, "--source", "bus", "--listen", hub, *written)
            )
            _wait_for_line(run, "running\n")
            there = ("--connect", hub, "--listen", f"tls/{hosts.camera_at}:0", "--field", followed.field, "--tls", keys)
            film = ("--camera.source", f"mcap:{source}")
            closing.enter_context(hosts.started(hosts.camera, "stage", "camera", *there, *film))
            time.sleep(_BEFORE_S)
            began_ns = time.time_ns()
            hosts.cut()
            time.sleep(PAUSE_S)
            hosts.mend()
            gone_ns = time.time_ns()
            time.sleep(_AFTER_S)
        frames, wrong = _read(rows, followed)
    verdict.back_s = back_s(frames, gone_ns)
    numbers = [frame.frame_id for frame in frames]
    verdict.without_pose = max(numbers, default=0) - min(numbers, default=0) + 1 - len(numbers)
    verdict.judge_time()
    if not any(frame.capture_ns < began_ns for frame in frames):
        verdict.problems.append("nothing was tracked before")
    return Played([verdict], wrong, frames=len(frames))


def full(source: Path, followed: Followed) -> Played:
    """A recording that outgrows its disk: tracking goes on, one line tells it, and what was written can be read."""
    verdict = Verdict(Event(Kind.FULL))
    with _small_disk() as disk, tempfile.TemporaryDirectory(prefix="fieldpose-chaos-") as folder:
        recording, rows = disk / "run.mcap", Path(folder) / "run.csv"
        arguments = ("--source", f"mcap:{source}", "--camera.frames", _DISK_FRAMES, "--record", recording)
        done = subprocess.run(
            _command("run", followed.field, *arguments, "--csv", rows), capture_output=True, text=True, timeout=_READY_S
        )
        said = [line for line in done.stderr.splitlines() if line.startswith("fieldpose: ")]
        if done.returncode == 0 or len(said) != 1 or "ended early" not in said[0]:
            verdict.problems.append(f"exit code {done.returncode}, and said {said}")
        try:
            if not _readable(recording, Path(folder) / "saved.mcap"):
                verdict.problems.append("nothing can be read of the recording")
        except FieldposeError as error:
            verdict.problems.append(f"the recording cannot be read: {error}")
    return Played([verdict])


def _readable(recording: Path, saved: Path) -> int:
    """How many messages a recording holds, or what can be saved of it."""
    unfinished = unfinished_file(recording)
    return info(recording).messages if unfinished is None else recover(unfinished, saved)


@contextmanager
def _small_disk() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="fieldpose-disk-") as folder:
        subprocess.run(
            ["mount", "-t", "tmpfs", "-o", f"size={_DISK_MB}m", "tmpfs", folder], check=True, capture_output=True
        )
        try:
            yield Path(folder)
        finally:
            subprocess.run(["umount", folder], check=True, capture_output=True)


def _command(*arguments: object) -> list[str]:
    return [*FIELDPOSE, *map(str, arguments)]


def _wait_for_line(process: subprocess.Popen[str], end: str) -> None:
    assert process.stderr is not None
    for line in process.stderr:
        if line.endswith(end):
            return
    raise FieldposeError("bench chaos: the run on the other host did not start")


def _read(rows: Path, followed: Followed) -> tuple[list[FrameResult], list[Wrong]]:
    """When each frame was answered and with what state, as the run has written it; those that were wrong."""
    frames, wrong = [], []
    with rows.open(newline="") as file:
        for row in csv.DictReader(file):
            number, capture_ns = int(row["frame_id"]), int(row["capture_ns"])
            frame = FrameResult(number, capture_ns, "finished", state=row["state"] or None)
            if row["cam_from_object_00"] and row["latency_ms"]:
                answered_ns = capture_ns + int(float(row["latency_ms"]) * 1e6)
                frame = replace(frame, cam_from_object=np.eye(4), answered_ns=answered_ns)
            frames.append(frame)
            if row["state"] == TrackingState.TRACKING and row["rotation_error_deg"]:
                turn, shift = float(row["rotation_error_deg"]), float(row["translation_error"])
                if turn > followed.limit.angle_deg or shift > followed.limit.distance:
                    wrong.append(Wrong(number, turn, shift, carried=False))
    return frames, wrong
