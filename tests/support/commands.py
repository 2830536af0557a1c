"""Running `fieldpose` as its users do, and the smallest field that it accepts."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import psutil

from fieldpose.stages.nerf.config import FieldConfig
from fieldpose.stages.nerf.field import Field, new_net
from fieldpose.stages.nerf.metadata import FieldMetadata, Space, TrainingCamera

_ENDED_S = 60.0


def command(*arguments: object) -> list[str]:
    """The command line of `fieldpose`."""
    return [sys.executable, "-P", "-m", "fieldpose", *(str(argument) for argument in arguments)]


def fieldpose(*arguments: object, cwd: Path, timeout_s: float = 60.0) -> subprocess.CompletedProcess[str]:
    """Run `fieldpose` in a folder, to its end."""
    return subprocess.run(command(*arguments), cwd=cwd, timeout=timeout_s, capture_output=True, text=True)


@contextmanager
def in_process(*arguments: object) -> Iterator[subprocess.Popen[str]]:
    """`fieldpose` with these arguments; it and all that it started are gone in the end."""
    running = subprocess.Popen(command(*arguments), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        yield running
    finally:
        processes = psutil.Process(running.pid).children(recursive=True) if running.poll() is None else []
        running.send_signal(signal.SIGINT)
        running.communicate(timeout=_ENDED_S)
        _, alive = psutil.wait_procs(processes, timeout=_ENDED_S)
        assert all(process.status() == psutil.STATUS_ZOMBIE for process in alive)


def save_empty_field(path: Path) -> Path:
    """A field that shows nothing, with one training view named `front`."""
    config = FieldConfig(levels=2, log2_table=8, hidden=8, colour_hidden=8, occupancy_resolution=8)
    pose = np.eye(4)
    pose[2, 3] = 4.0
    front = TrainingCamera("front", 32, 32, 40.0, 40.0, 15.5, 15.5, (0.0,) * 5, tuple(pose.ravel().tolist()))
    metadata = FieldMetadata(Space(False, (0.0, 0.0, 0.0), 1.0), config, (1.0, 1.0, 1.0), [front], "blender", "0" * 64)
    Field(metadata, new_net(config, np.random.default_rng(0)), np.zeros((8, 8, 8), bool)).save(path)
    return path
