"""Learning a field: both learners get better, depth is where the surface is, Ctrl-C keeps what was learnt."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from support import posed_images
from support.analytic_scene import AnalyticScene
from threadpoolctl import threadpool_limits

from fieldpose.errors import ConfigError, DatasetError
from fieldpose.stages.geometry import Camera, look_at, rays
from fieldpose.stages.nerf import from_dataset
from fieldpose.stages.nerf.blocks import View
from fieldpose.stages.nerf.config import FieldConfig, TrainingConfig
from fieldpose.stages.nerf.field import load_field
from fieldpose.stages.nerf.loading import load_renderer
from fieldpose.stages.nerf.metadata import FieldMetadata, Space
from fieldpose.stages.nerf.raybank import Batch
from fieldpose.stages.nerf.renderer import NumbaRenderer
from fieldpose.stages.nerf.torch_renderer import torch_device
from fieldpose.stages.nerf.torch_training import TorchTrainer
from fieldpose.stages.nerf.training import Trainer, evaluate

SMALL = FieldConfig(
    levels=4, log2_table=14, finest_resolution=96, hidden=32, features=7, colour_hidden=16, occupancy_resolution=32
)
SPACE = Space(False, (0.0, 0.0, 0.0), 1.3, step=2 / 96)
SIZE = 48


@cache
def views() -> tuple[View, ...]:
    scene = AnalyticScene()
    camera = Camera(SIZE, SIZE, 60.0, 60.0, (SIZE - 1) / 2, (SIZE - 1) / 2)
    result = []
    for i in range(16):
        angle, height = 2.4 * i, 0.8 + 1.6 * (i % 4) / 3
        eye = np.array([3 * np.cos(angle), 3 * np.sin(angle), height])
        rendered = scene.render_view(camera, look_at(eye, np.zeros(3), np.array([0, 0, 1.0])))
        origins, directions = rays(camera, rendered.cam_from_object)
        points = origins + rendered.depth.reshape(-1, 1) * directions
        colour = (0.5 + 0.4 * np.sin(7 * points)).reshape(SIZE, SIZE, 3)
        rgba = (np.dstack([colour, rendered.opacity]) * 255).astype(np.uint8)
        result.append(View(f"{i}", rgba, camera, rendered.cam_from_object))
    return tuple(result)


def small_dataset(root: Path) -> Path:
    posed_images.write_blender(root, posed_images.centred(24, 24, 30.0))
    return root


def learnt(steps: int) -> tuple[NumbaRenderer, list[float]]:
    trainer = Trainer(list(views()[2:]), SPACE, SMALL, TrainingConfig(steps=steps, threads=1, samples_per_step=6000))
    progress: list[float] = []
    trainer.run(lambda p: progress.append(p.train_psnr_db))
    metadata = FieldMetadata(SPACE, SMALL, (1.0, 1.0, 1.0), [], "test", "")
    return NumbaRenderer(trainer.field(metadata)), progress


def test_learns_colours_and_depths_of_views_it_has_not_seen() -> None:
    renderer, progress = learnt(600)
    assert progress[-1] > progress[3] + 6
    assert np.mean(evaluate(renderer, list(views()[:2]))) > 19
    view = views()[0]
    truth = AnalyticScene().render_view(view.camera, view.cam_from_object)
    found = renderer.render_view(view.camera, view.cam_from_object)
    inside = (truth.opacity > 0.99) & (found.opacity > 0.9)
    assert inside.sum() > 300
    assert np.median(np.abs(found.depth - truth.depth)[inside] / truth.depth[inside]) < 0.03
    outside = truth.opacity < 0.01
    assert found.opacity[outside].mean() < 0.1


def test_the_torch_learner_learns_from_the_same_batches() -> None:
    config = TrainingConfig(steps=90, threads=1, samples_per_step=4000, backend="torch")
    learner = TorchTrainer(list(views()), SPACE, SMALL, config, torch.device("cpu"))
    with threadpool_limits(1):  # tensors so small take ten times as long where threads wait for each other
        errors = [learner.step(i / 90) for i in range(90)]
    assert np.mean(errors[-5:]) < 0.7 * np.mean(errors[:3])
    kernels = Trainer(list(views()), SPACE, SMALL, config)
    assert [kernels.step(i / 90) for i in range(3)] == pytest.approx(errors[:3], rel=0.05)


def test_the_same_seed_learns_the_same_field() -> None:
    config = TrainingConfig(steps=5, threads=1, samples_per_step=2000)
    first, second = (Trainer(list(views()), SPACE, SMALL, config) for _ in range(2))
    assert [first.step(0) for _ in range(5)] == [second.step(0) for _ in range(5)]
    np.testing.assert_array_equal(first.net().table, second.net().table)


def test_from_dataset_to_file_and_back(tmp_path: Path) -> None:
    dataset = small_dataset(tmp_path / "data")
    out = tmp_path / "deep" / "field.safetensors"
    training = TrainingConfig(steps=4, threads=1, samples_per_step=1000)
    reports: list[from_dataset.TrainingReport] = []
    trained = from_dataset.train_field(dataset, out, 24, training=training, config=SMALL, report=reports.append)
    assert reports
    assert not trained.interrupted
    metadata = load_field(out).metadata
    assert metadata.trained_steps == 4
    assert metadata.psnr_db == pytest.approx(np.mean(trained.test_psnr_db))
    assert len(metadata.dataset_sha256) == 64
    assert [c.name for c in metadata.cameras]
    camera = metadata.cameras[0]
    pose = np.array(camera.cam_from_object).reshape(4, 4)
    small = Camera(8, 8, 8.0, 8.0, 3.5, 3.5)
    assert load_renderer(out).render_view(small, pose).rgb.shape == (8, 8, 3)


def test_ctrl_c_keeps_what_was_learnt(tmp_path: Path) -> None:
    dataset = small_dataset(tmp_path / "data")
    out = tmp_path / "field.safetensors"

    def interrupt(_: from_dataset.TrainingReport) -> None:
        raise KeyboardInterrupt

    training = TrainingConfig(minutes=5, threads=1, samples_per_step=1000)
    trained = from_dataset.train_field(dataset, out, 24, training=training, config=SMALL, report=interrupt)
    assert trained.interrupted
    assert load_field(out).metadata.trained_steps >= 1


def test_ctrl_c_while_the_field_is_tried_keeps_what_it_remembers(tmp_path: Path) -> None:
    out = tmp_path / "field.safetensors"

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        from_dataset.train_field(
            small_dataset(tmp_path / "data"), out, 24, training=TrainingConfig(steps=1), config=SMALL,
            remember=lambda images: np.zeros((len(list(images)), 128, 64), np.int8), examine=interrupt,
        )  # fmt: skip
    field = load_field(out)
    assert field.descriptors is not None
    assert len(field.descriptors) == len(field.metadata.cameras)


def test_a_bad_dataset_leaves_no_field(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="no such folder"):
        from_dataset.train_field(tmp_path / "none", tmp_path / "field.safetensors")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_cuda_without_a_device_is_refused() -> None:
    with pytest.raises(ConfigError, match="no CUDA device"):
        torch_device("cuda")


def test_rays_that_begin_late_are_learnt_from_and_not_judged_by(monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = Trainer(list(views()), SPACE, SMALL, TrainingConfig(steps=10, threads=1, samples_per_step=6000))
    centres = {tuple(origin) for origin in trainer._bank._origin}
    shares = []

    def learn(batch: Batch, jitter: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray, int]:
        late = np.array([tuple(origin) not in centres for origin in batch.origins])
        shares.append(float(late.mean()))
        return late.astype(np.float32), np.zeros(len(late), np.float32), len(late)

    monkeypatch.setattr(trainer, "learn", learn)
    assert [trainer.step(fraction) for fraction in (0.0, 0.25, 0.5)] == [0, 0, 0]
    assert not trainer._bank.blocks.error.any()
    assert shares == pytest.approx([0.5, 0.25, 0.0], abs=0.1)
