"""The benchmarks run and write what they promise; what they measure is not judged here."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
from support import posed_images
from support.analytic_scene import AnalyticScene, camera, viewpoint

from fieldpose.deploy.benchmarks import machine
from fieldpose.deploy.benchmarks.match import RIGHT_PX, Pair, is_right
from fieldpose.deploy.cli import main
from fieldpose.stages.geometry import points_at_depth
from fieldpose.stages.matching.core import MatchedPixels
from fieldpose.stages.nerf.config import FieldConfig, TrainingConfig
from fieldpose.stages.nerf.field import Field, load_field
from fieldpose.stages.nerf.from_dataset import train_field

SMALL = FieldConfig(levels=2, log2_table=8, hidden=8, colour_hidden=8, occupancy_resolution=16, finest_resolution=32)
KILLED = """
import os, signal
import psutil
from fieldpose.deploy.benchmarks import echo, other_end
with echo.hub() as hub, other_end.other_process(hub), echo.session(hub) as bus:
    echo.Echo(bus)
    print(psutil.Process().children()[0].pid, flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
"""
MODEL = ["--model.levels", 2, "--model.log2-table", 8, "--model.occupancy-resolution", 16]


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    posed_images.write_blender(tmp_path / "data", posed_images.centred(32, 32, 40.0))
    return tmp_path / "data"


@pytest.fixture
def one_core(monkeypatch: pytest.MonkeyPatch) -> None:
    """Networks so small take many times as long where their threads wait for each other, as on a busy machine."""
    monkeypatch.setattr(machine, "cores", lambda: 1)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")


@pytest.mark.usefixtures("one_core")
def test_rendering_is_measured_at_each_size(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    field, figures = tmp_path / "field.safetensors", tmp_path / "render.json"
    train_field(dataset, field, 32, training=TrainingConfig(steps=20), config=SMALL)
    learnt = load_field(field)
    Field(learnt.metadata, learnt.net, np.ones_like(learnt.occupied)).save(field)
    arguments = ["--dataset", dataset, "--field", field, "--sizes", 16, 32, "--views", 1, "--out", tmp_path / "plots"]
    assert main(["bench", "render", *map(str, arguments), "--json", str(figures)]) == 0
    written = json.loads(figures.read_text())
    assert set(written["sizes"]) == {"16", "32"}
    for row in written["sizes"].values():
        assert row["ms_per_view"] > 0
        assert row["speedup"] == pytest.approx(row["twin_ms_per_view"] / row["ms_per_view"])
        assert row["psnr_db"] == pytest.approx(row["twin_psnr_db"], abs=0.3)
        assert 0 < row["fraction_of_limit"] < 1
    assert written["rss_mb"] > 50
    assert (tmp_path / "plots" / "render.png").read_bytes().startswith(b"\x89PNG")
    assert "times faster" in capsys.readouterr().out


@pytest.mark.usefixtures("one_core")
def test_training_is_measured_over_time(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    figures = tmp_path / "train.json"
    steps = ["--minutes", 0.02, "--twin-steps", 2, "--memory-steps", 2]
    arguments = ["--datasets", dataset, *steps, *MODEL, "--out", tmp_path / "plots"]
    assert main(["bench", "train", *map(str, arguments), "--json", str(figures)]) == 0
    written = json.loads(figures.read_text())
    assert written["samples_per_s"] > 0
    assert written["speedup"] == pytest.approx(written["samples_per_s"] / written["twin_samples_per_s"])
    assert set(written["psnr_db"]) == {"data"}
    assert list(written["psnr_db"]["data"]) == ["1.2"]
    assert written["rss_mb"] > 50
    assert written["depth_error"] == {}
    assert 0 <= written["silhouette_coverage"]["data"]["1.2"] <= 1
    assert (tmp_path / "plots" / "train.png").read_bytes().startswith(b"\x89PNG")
    assert "PSNR on held-out views" in capsys.readouterr().out


def test_matchers_are_measured_at_each_size(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    figures = tmp_path / "match.json"
    arguments = ["--matchers", "sift", "loftr", "--sizes", 96, 128, "--pairs", 2, "--threads", 1]
    assert main(["bench", "match", *map(str, arguments), "--json", str(figures)]) == 0
    written = json.loads(figures.read_text())
    assert set(written["sizes"]) == {"96", "128"}
    for rows in written["sizes"].values():
        assert {"sift", "loftr"} == rows.keys() | written["missing"].keys()
        assert rows["sift"]["ms_per_pair"] > 0
        assert rows["sift"]["ms_view_known"] > 0
        assert rows["sift"]["matches"] > 10
        assert 0.5 < rows["sift"]["share_right"] <= 1
    shown = capsys.readouterr().out
    assert "view known" in shown
    assert all(f"{name} is left out: {reason[:20]}" in shown for name, reason in written["missing"].items())


def test_matches_are_right_within_two_pixels_of_the_same_point() -> None:
    seen_by, there = camera(64), viewpoint(32)
    view = AnalyticScene().render_view(seen_by, viewpoint(20))
    inside = np.argwhere(view.opacity > 0.999)[::9, ::-1].astype(np.float32)
    depths = view.depth[inside[:, 1].astype(int), inside[:, 0].astype(int)]
    points = points_at_depth(seen_by, view.cam_from_object, inside, depths)
    exact = seen_by.project(points @ there[:3, :3].T + there[:3, 3]).astype(np.float32)
    pair = Pair(view, view.rgb, seen_by, there)
    for off, right in ((0.0, True), (0.9 * RIGHT_PX, True), (1.1 * RIGHT_PX, False)):
        found = MatchedPixels(inside, exact + np.float32([off, 0]), np.ones(len(inside), np.float32))
        assert is_right(pair, found).tolist() == [right] * len(inside)
    outside = np.argwhere(view.opacity == 0)[:5, ::-1].astype(np.float32)
    assert not is_right(pair, MatchedPixels(outside, outside, np.ones(5, np.float32))).any()


def test_the_bus_is_measured_by_message_and_by_frame(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    figures = tmp_path / "bus.json"
    few = ["--trips", 5, "--flow-mb", 0.2, "--frames", 3]
    arguments = ["--payloads", 1024, 65536, "--sizes", "48x36", *few]
    before = {process.pid for process in psutil.Process().children(recursive=True)}
    assert main(["bench", "bus", *map(str, arguments), "--json", str(figures)]) == 0
    assert {process.pid for process in psutil.Process().children(recursive=True)} <= before
    written = json.loads(figures.read_text())
    assert set(written["payloads"]) == {"1024", "65536"}
    for size, row in written["payloads"].items():
        assert row["lost"] == row["lost_in_flow"] == 0
        for way in ("one_way_ms", "round_trip_ms"):
            assert 0 < row[way]["p50"] <= row[way]["p90"] <= row[way]["p99"]
        assert row["one_way_ms"]["p50"] < row["round_trip_ms"]["p99"]
        assert row["mb_per_s"] == pytest.approx(row["messages_per_s"] * int(size) / 1e6)
        assert row["encode_ms"] > 0
        assert row["decode_ms"] > 0
    (frame,) = written["frames"].values()
    assert frame["rgb8_bytes"] == 48 * 36 * 3
    assert 0 < frame["jpeg_bytes"] < frame["rgb8_bytes"]
    for way in ("jpeg", "rgb8"):
        once, each = frame[f"{way}_ms_cpu_sender"], frame[f"{way}_ms_cpu_receiver"]
        assert min(once, each, frame[f"{way}_ms_to_pixels"]) > 0
        assert frame[f"{way}_ms_cpu"] == pytest.approx(once + written["receivers"] * each)
    assert "pixels save" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--sizes", "640"], "640x480"),
        (["--payloads", "4"], "at least 8 bytes"),
        (["--frames", "0"], "at least one of each"),
    ],
)
def test_a_bus_that_cannot_be_measured_so_is_told(
    arguments: list[str], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bench", "bus", *arguments]) == 2
    assert complaint in capsys.readouterr().err


def test_the_other_process_ends_with_the_one_that_started_it() -> None:
    killed = subprocess.run(
        [sys.executable, "-P", "-c", KILLED], capture_output=True, text=True, timeout=60, check=False
    )
    assert killed.returncode == -signal.SIGKILL
    (pid,) = map(int, killed.stdout.split())
    deadline = time.monotonic() + 10
    while psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE:
        assert time.monotonic() < deadline, "still running"
        time.sleep(0.05)


@pytest.mark.parametrize("what", ["render", "train", "match", "bus", "track", "mesh"])
def test_help_of_each_has_an_example(what: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["bench", what, "--help"])
    assert f"Example: fieldpose bench {what} --json" in " ".join(capsys.readouterr().out.split())
