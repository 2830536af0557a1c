"""The whole pipeline in real processes, on the embedded scene: killed stages, Ctrl-C, recordings, replay."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Sequence
from contextlib import nullcontext
from itertools import takewhile
from pathlib import Path

import psutil
import pytest
from support.commands import command

from fieldpose.bus.open_recording import unfinished_file
from fieldpose.bus.reading import info
from fieldpose.bus.topics import ALL
from fieldpose.deploy.cli import main
from fieldpose.deploy.graph import (
    BY_NAME,
    CAMERA,
    GRAPH,
    HUB,
    OBSERVER,
    RECORDER,
    STAGES,
    thread_environment,
    threads_of,
)
from fieldpose.deploy.plan import resolve
from fieldpose.deploy.processes.pipeline import Progress
from fieldpose.deploy.processes.programs import programs
from fieldpose.deploy.processes.supervision import Program
from fieldpose.deploy.scene import demo_file
from fieldpose.deploy.settings import Settings, changed

FRAMES = 8
SMALL = [
    "--camera.pace", "lockstep", "--camera.frames", str(FRAMES), "--rendering.size", "128",
    "--tracking.guess", "perturb:4-8deg,0.05", "--tracking.passes", "2", "--tracking.min-deadline-ms", "3000",
]  # fmt: skip


def descendants() -> set[int]:
    return {process.pid for process in psutil.Process().children(recursive=True)}


def pid_of(stage: str, below: int | None = None) -> int:
    """The process of a stage below a process, or this one."""
    for process in psutil.Process(below).children(recursive=True):
        words = " ".join(process.cmdline()).split()
        if "stage" in words and words[words.index("stage") + 1] == stage:
            return process.pid
    raise AssertionError(f"{stage} is not running")


def of(made: Sequence[Program], name: str, flag: str) -> list[str]:
    """What a program is given for a flag."""
    words = list(next(program for program in made if program.name == name).command)
    after = words[words.index(flag) + 1 :] if flag in words else []
    return list(takewhile(lambda word: not word.startswith("--"), after))


def test_a_run_has_every_process_that_its_plan_wants(tmp_path: Path) -> None:
    plan = resolve(changed(Settings(), {"tracking": {"guess": "perturb:4-8deg,0.05"}}, "test"), None, Path("field"))
    made = programs([plan], tmp_path, "tcp/127.0.0.1:1", tmp_path / "a.mcap")
    assert {program.name for program in made} == set(BY_NAME) == {HUB, RECORDER, *STAGES}
    assert [program.name for program in made if program.ends] == [CAMERA]
    assert set(of(made, CAMERA, "--wait-for")) == {OBSERVER, RECORDER, *STAGES} - {CAMERA}
    assert of(made, "matching", "--wait-for") == [OBSERVER, RECORDER]
    assert (of(made, RECORDER, "--record"), of(made, "matching", "--record")) == ([str(tmp_path / "a.mcap")], [])
    matching = next(program for program in made if program.name == "matching")
    assert matching.environment["OMP_NUM_THREADS"] == matching.environment["NUMBA_NUM_THREADS"]
    alone = resolve(changed(Settings(), {"retrieval": {"candidates": 0}}, "test"), None, Path("field"))
    named = {program.name for program in programs([alone], tmp_path, "tcp/127.0.0.1:1", None)}
    assert named == set(BY_NAME) - {RECORDER, "perturbation", "retrieval"}


def test_of_several_pipelines_most_processes_serve_all_and_wait_for_those_of_their_camera(tmp_path: Path) -> None:
    plans = [
        resolve(
            changed(
                Settings(),
                {
                    "address": {"object": object, "camera": camera},
                    "camera": {"objects": ("lamp", "can"), "truth_of": "can" if camera == "right" else None},
                },
                "test",
            ), None, Path(f"{object}.safetensors"),
        )
        for camera in ("left", "right") for object in ("lamp", "can")
    ]  # fmt: skip
    made = programs(plans, tmp_path, "tcp/127.0.0.1:1", tmp_path / "a.mcap")
    shared = {row.name for row in GRAPH if row.serves == "run"}
    assert shared == set(BY_NAME) - {CAMERA, "tracking", "perturbation"}
    pairs = [f"{object}@{camera}" for camera in ("left", "right") for object in ("lamp", "can")]
    each = {f"tracking@{pair}" for pair in pairs}
    assert {program.name for program in made} == {*shared, *each, f"{CAMERA}@left", f"{CAMERA}@right"}
    assert {program.name for program in made if program.ends} == {f"{CAMERA}@left", f"{CAMERA}@right"}
    waits = set(of(made, f"{CAMERA}@left", "--wait-for"))
    stages = set(STAGES) - {CAMERA, "perturbation"}
    assert waits == {OBSERVER, RECORDER, *stages, *(f"can/left/{stage}" for stage in stages)}
    # This camera is at home with the object whose true poses it knows.
    waits = set(of(made, f"{CAMERA}@right", "--wait-for"))
    listeners = {f"lamp/left/{name}" for name in (OBSERVER, RECORDER)}
    assert waits == {*listeners, *stages, *(f"lamp/right/{stage}" for stage in stages)}
    assert of(made, "tracking@can@right", "--wait-for") == [f"lamp/left/{name}" for name in (OBSERVER, RECORDER)]
    (file,) = {tuple(of(made, name, "--pipelines")) for name in shared - {HUB}}
    listed = json.loads(Path(file[0]).read_text())["pipelines"]
    assert [Path(one["field"]).stem for one in listed] == ["lamp", "can", "lamp", "can"]
    assert len({one["settings"] for one in listed}) == 4
    assert of(made, "tracking@can@right", "--config") == [listed[3]["settings"]]
    assert {*stages, CAMERA, RECORDER, HUB} == set(listed[0]["processes"])


def test_threads_are_shared_between_the_processes_at_work() -> None:
    assert threads_of(BY_NAME["rendering"], depth=2, cores=2) == 1
    assert threads_of(BY_NAME["rendering"], depth=1, cores=2) == 2
    assert threads_of(BY_NAME["matching"], depth=2, cores=16) == 8
    assert threads_of(BY_NAME["pnp"], depth=1, cores=16) == 1
    assert set(thread_environment(3).values()) == {"3", "passive", "0"}


@pytest.mark.slow
def test_a_stage_killed_in_the_demo_comes_back_and_the_recording_is_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    killed: list[int] = []
    before = descendants()

    def kill_rendering(progress: Progress) -> None:
        if not killed and any(one.state is not None and one.state.finished >= 2 for one in progress.standings):
            killed.append(pid_of("rendering"))
            os.kill(killed[0], signal.SIGKILL)

    older = tmp_path / "older.txt"
    older.touch()
    monkeypatch.setattr("fieldpose.deploy.commands.demo.live_line", lambda title: nullcontext(kill_rendering))
    assert main(["demo", "--out", str(tmp_path), *SMALL]) == 0
    assert killed
    assert descendants() <= before
    assert {path.name for path in tmp_path.iterdir()} == {
        older.name, "summary.json", "recording.mcap", "timeline.png", "overlay.jpg", "overlay.mp4",
    }  # fmt: skip
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["restarts"] == {"rendering": 1}
    assert summary["frames_sent"] == summary["frames"] == FRAMES
    assert summary["frames_lost"] <= FRAMES // 2
    assert summary["poses_ok"] >= FRAMES - summary["frames_lost"] - 1
    assert summary["rotation_error_deg"]["median"] < 0.5
    assert summary["translation_error"]["median"] < 0.05
    assert summary["latency_ms"]["p50"] > 0
    held = info(tmp_path / "recording.mcap")
    assert held.lossless
    assert summary["messages"]["recorded"] == held.messages
    assert summary["messages"]["lost"] <= 2  # what was under way at the kill may have reached only some
    by_topic = {topic.topic: topic.messages for topic in held.topics if topic.topic != "stats"}
    assert by_topic["frame"] == by_topic["truth"] == by_topic["state"] == FRAMES
    unsaid = {"stats", "search", "retrieved", "failure", "followed", "control"}
    assert {topic.name for topic in ALL} - by_topic.keys() <= unsaid
    assert set(held.attachments) == {"settings.json", "field.safetensors"}
    said = capsys.readouterr().out
    assert "rendering 1x" in said
    assert "timeline.png" in said
    assert older.name not in said

    figures = tmp_path / "replay.json"
    assert main(["replay", str(tmp_path / "recording.mcap"), "--json", str(figures)]) == 0
    compared = json.loads(figures.read_text())
    assert compared["compared"] == summary["poses_ok"]
    assert compared["rotation_difference_deg"]["median"] < 0.1
    assert "from the recorded poses, rotation" in capsys.readouterr().out


def recorded_run(recording: Path, *options: object) -> subprocess.Popen[str]:
    """A run of the demo's film, of which some is recorded already."""
    source = f"mcap:{demo_file('sequence.mcap')}"
    arguments = ["--source", source, "--guess", "train:047", "--rendering.size", "128", "--record", recording, *options]
    running = subprocess.Popen(
        command("run", demo_file("field.safetensors"), *arguments),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert running.stderr is not None
    for line in running.stderr:
        if line.endswith("running\n"):
            break
    time.sleep(1.5)
    return running


@pytest.mark.slow
def test_ctrl_c_ends_every_process_and_leaves_a_finished_recording(tmp_path: Path) -> None:
    recording, figures = tmp_path / "run.mcap", tmp_path / "run.json"
    running = recorded_run(recording, "--json", figures)
    processes = psutil.Process(running.pid).children(recursive=True)
    assert len(processes) >= len(BY_NAME) - 1
    running.send_signal(signal.SIGINT)
    assert running.wait(timeout=60) == 130
    running.stderr.close()
    assert not any(process.is_running() for process in processes)
    held = info(recording)
    assert {"frame", "truth", "state"} <= {topic.topic for topic in held.topics if topic.messages}
    assert [path.name for path in tmp_path.glob("*.partial")] == []
    assert json.loads(figures.read_text())["frames_sent"] > 0


@pytest.mark.slow
@pytest.mark.parametrize("again", [False, True])
def test_after_ctrl_c_a_slow_recorder_is_waited_for_unless_there_is_a_second_one(tmp_path: Path, again: bool) -> None:
    recording = tmp_path / "run.mcap"
    running = recorded_run(recording)
    recorder = psutil.Process(pid_of(RECORDER, running.pid))
    # As one is whose disk takes longer than a heartbeat may be missing, once nobody looks for these any more.
    running.send_signal(signal.SIGINT)
    recorder.suspend()
    with pytest.raises(subprocess.TimeoutExpired):
        running.wait(timeout=8.0)
    if again:
        running.send_signal(signal.SIGINT)
        assert running.wait(timeout=20) == 2
        assert (
            running.stderr.read().splitlines()[-1].startswith(f"fieldpose: {recording}: the recording was not finished")
        )
        assert unfinished_file(recording) is not None
    else:
        recorder.resume()
        assert running.wait(timeout=20) == 130
        assert info(recording).messages > 0
        assert list(tmp_path.iterdir()) == [recording]
    running.stderr.close()


@pytest.mark.slow
def test_ctrl_c_while_kernels_are_compiled_ends_every_process_and_leaves_no_recording(tmp_path: Path) -> None:
    source, caches = f"mcap:{demo_file('sequence.mcap')}", tmp_path / "caches"
    arguments = ["--source", source, "--record", str(tmp_path / "run.mcap"), "--json", str(tmp_path / "run.json")]
    running = subprocess.Popen(
        command("run", demo_file("field.safetensors"), *arguments),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "NUMBA_CACHE_DIR": str(caches)},
    )
    assert running.stderr is not None
    for line in running.stderr:
        if line.endswith("starting\n"):
            break
    processes = psutil.Process(running.pid).children(recursive=True)
    assert processes
    running.send_signal(signal.SIGINT)
    assert running.wait(timeout=20) == 130
    assert running.stderr.read() == f"{source}: finishing\n"
    running.stderr.close()
    _, alive = psutil.wait_procs(processes, timeout=10)
    assert all(process.status() == psutil.STATUS_ZOMBIE for process in alive)
    assert not list(tmp_path.glob("*.mcap*"))
