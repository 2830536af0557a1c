"""How a mesh is held against the true surface, on a ball that is known."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.surfaces import BALL_RADIUS, RED, around, ball_field, views_of

from fieldpose.deploy.benchmarks.mesh import level_set
from fieldpose.deploy.cli import main
from fieldpose.stages.geometry import Camera, inverse

CELL = 2 / 32
SIZE = 64
OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


def write_ball(root: Path, radius: float = BALL_RADIUS, depth: bool = True) -> None:
    """A dataset whose test views look at a ball, with its depth."""
    poses = around(8)
    focal = 90.0
    views = views_of(lambda p: np.linalg.norm(p, axis=-1) - radius, poses, Camera(SIZE, SIZE, focal, focal, 31.5, 31.5))
    seen = np.isfinite(views.depth)
    frames: dict[str, list[dict[str, object]]] = {"train": [], "test": []}
    for i, pose in enumerate(poses):
        split = "test" if i else "train"
        (root / split).mkdir(parents=True, exist_ok=True)
        pixels = np.where(seen[i][..., None], RED, 255).astype(np.uint8)
        alpha = np.dstack([pixels[..., ::-1], np.where(seen[i], 255, 0).astype(np.uint8)])
        cv2.imwrite(str(root / f"{split}/{i}.png"), alpha)
        cv2.imwrite(str(root / f"{split}/{i}_depth.png"), np.where(seen[i], views.depth[i] * 5000, 0).astype(np.uint16))
        frame = {"file_path": f"{split}/{i}.png", "transform_matrix": (inverse(pose) @ OPENGL_FROM_OPENCV).tolist()}
        told = {"depth_file_path": f"{split}/{i}_depth.png", "depth_scale": 1 / 5000} if depth else {}
        frames[split].append(frame | told)
    content = {"camera_angle_x": 2 * np.arctan(SIZE / 2 / focal), "aabb": [[-1] * 3, [1] * 3]}
    for split, listed in frames.items():
        (root / f"transforms_{split}.json").write_text(json.dumps(content | {"frames": listed}))


def test_a_level_set_of_a_ball_is_near_the_ball() -> None:
    points, triangles = level_set(ball_field(), 40, 0.5)
    assert len(triangles) > 1000
    assert np.abs(np.linalg.norm(points, axis=1) - BALL_RADIUS).max() < 1.1 * CELL


@pytest.mark.parametrize(("radius", "off"), [(BALL_RADIUS, 0.0), (BALL_RADIUS - 0.1, 0.1)])
def test_meshes_are_measured_by_what_is_true(
    radius: float, off: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, few in (("_SAMPLES", 500), ("_TRUTHS", 1000), ("_DENSE", 200_000)):
        monkeypatch.setattr(f"fieldpose.deploy.benchmarks.mesh.{name}", few)
    write_ball(tmp_path / "data", radius)
    ball_field().save(tmp_path / "ball.safetensors")
    arguments = ["--dataset", str(tmp_path / "data"), "--field", str(tmp_path / "ball.safetensors")]
    out = tmp_path / "mesh.json"
    assert main(["bench", "mesh", *arguments, "--resolution", "40", "--json", str(out)]) == 0
    ways = json.loads(out.read_text())["ways"]
    assert "fused depth" in ways
    assert len(ways) == 4
    for way in ways.values():
        assert way["all"]["median"] == pytest.approx(off, abs=0.6 * CELL)
    assert (ways["fused depth"]["all"]["complete"] == 0) == (off > 0)


def test_a_dataset_without_depth_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_ball(tmp_path / "data", depth=False)
    ball_field().save(tmp_path / "ball.safetensors")
    arguments = ["--dataset", str(tmp_path / "data"), "--field", str(tmp_path / "ball.safetensors")]
    assert main(["bench", "mesh", *arguments]) == 2
    assert "have no true depth, by which a mesh could be measured" in capsys.readouterr().err
