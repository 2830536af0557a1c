"""The benchmarks run and write what they promise; what they measure is not judged here."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from support import posed_images
from support.analytic_scene import AnalyticScene, camera, viewpoint

from fieldpose.deploy.benchmarks.match import RIGHT_PX, Pair, is_right
from fieldpose.deploy.cli import main
from fieldpose.stages.geometry import points_at_depth
from fieldpose.stages.matching.core import MatchedPixels
from fieldpose.stages.nerf.config import FieldConfig, TrainingConfig
from fieldpose.stages.nerf.from_dataset import train_field

SMALL = FieldConfig(levels=2, log2_table=8, hidden=8, colour_hidden=8, occupancy_resolution=16, finest_resolution=32)
MODEL = ["--model.levels", 2, "--model.log2-table", 8, "--model.occupancy-resolution", 16]


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    posed_images.write_blender(tmp_path / "data", posed_images.centred(32, 32, 40.0))
    return tmp_path / "data"


def test_rendering_is_measured_at_each_size(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    field, figures = tmp_path / "field.safetensors", tmp_path / "render.json"
    train_field(dataset, field, 32, training=TrainingConfig(steps=20), config=SMALL)
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
