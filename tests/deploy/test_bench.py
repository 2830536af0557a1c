"""The benchmarks run and write what they promise; what they measure is not judged here."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from support import posed_images

from fieldpose.deploy.cli import main
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
