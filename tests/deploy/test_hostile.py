"""Strangers and buggy processes on the bus: nothing that they send is believed, ends anything, or costs memory."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import psutil
import pytest

from fieldpose.deploy.cli import main
from fieldpose.deploy.processes.pipeline import Progress
from fieldpose.deploy.reporting.results import RunResult
from fieldpose.deploy.scene import demo_file
from fieldpose.stages.geometry import rotation_error_deg, translation_error

HERE = Path(__file__).resolve().parent.parent
ATTACK_S = 7.0
WRONG_DEG, WRONG = 3.0, 0.15
"""Errors of a pose that is said to be tracking, in the unit of the demo, whose camera is some 3 away."""


@pytest.mark.slow
def test_a_stranger_on_the_bus_moves_no_pose_and_stops_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    strangers: list[subprocess.Popen[str]] = []
    memory_mb: dict[str, list[float]] = {}
    runs: list[RunResult] = []

    def report(progress: Progress) -> None:
        if not strangers:
            command = [sys.executable, "-m", "support.hostile", progress.hub, str(ATTACK_S)]
            paths = os.pathsep.join([str(HERE), *sys.path])
            stranger = subprocess.Popen(
                command, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": paths}
            )
            strangers.append(stranger)
        if any(standing.state is not None for standing in progress.standings):
            for name, pid in progress.pids.items():
                if psutil.pid_exists(pid):
                    memory_mb.setdefault(name, []).append(psutil.Process(pid).memory_info().rss / 2**20)

    def kept(outcome: RunResult) -> dict[str, object]:
        from fieldpose.deploy.reporting.results import summarise

        runs.append(outcome)
        return summarise(outcome)

    monkeypatch.setattr("fieldpose.deploy.commands.run.live_line", lambda title: nullcontext(report))
    monkeypatch.setattr("fieldpose.deploy.commands.run.summarise", kept)
    field, source = str(demo_file("field.safetensors")), f"mcap:{demo_file('sequence.mcap')}"
    files = ["--json", str(tmp_path / "summary.json"), "--record", str(tmp_path / "recording.mcap")]
    try:
        slow = ["--camera.rate-hz", "15", "--rendering.size", "128", "--tracking.guess", "train:047"]
        # Where certificates are asked for, nobody gets as far as this.
        assert main(["run", field, "--source", source, "--open", *files, *slow]) == 0
        said, _ = strangers[0].communicate(timeout=30)
    finally:
        for stranger in strangers:
            stranger.kill()
            stranger.wait()
    attack = json.loads(said)
    assert set(attack["sent"]) == {"poses", "new sources", "numbers", "times", "bytes", "everything", "greetings"}
    (outcome,) = runs
    tracked = [frame for frame in outcome.frames if frame.state == "tracking" and frame.cam_from_object is not None]
    for frame in tracked:
        assert frame.truth is not None
        assert frame.truth.cam_from_object is not None
        assert rotation_error_deg(frame.cam_from_object, frame.truth.cam_from_object) < WRONG_DEG
        assert translation_error(frame.cam_from_object, frame.truth.cam_from_object) < WRONG
    after = [frame for frame in outcome.frames if (frame.sent_ns or 0) > attack["ended_ns"] + 2 * 10**9]
    assert len(after) > 10
    assert np.mean([frame in tracked for frame in after]) > 0.8
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["restarts"] == {}
    assert summary["frames_sent"] == 300
    assert summary["messages"]["lost"] < 10_000
    assert sum(stats.refused for stats in outcome.stats.values()) > 1000
    for name, sizes in memory_mb.items():
        # Zenoh holds 64 messages of a topic for the recorder, and those of the attack are up to 5 MB.
        assert max(sizes) - sizes[0] < (450 if name == "recorder" else 150), name
