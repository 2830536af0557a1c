"""Scenes whose box ends at their walls and whose cameras are within it: neither haze nor the box's faces may win."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from support import posed_images
from support.wires import scene

from fieldpose.stages.geometry import Camera, look_at
from fieldpose.stages.nerf import from_dataset, training
from fieldpose.stages.nerf.blocks import View
from fieldpose.stages.nerf.config import FieldConfig, TrainingConfig
from fieldpose.stages.nerf.datasets import load_dataset
from fieldpose.stages.nerf.field import Field, new_net
from fieldpose.stages.nerf.metadata import FieldMetadata, Space
from fieldpose.stages.nerf.renderer import NumbaRenderer

SMALL = FieldConfig(
    levels=4, log2_table=15, finest_resolution=128, hidden=32, features=7, colour_hidden=16, occupancy_resolution=64
)
HOW = TrainingConfig(steps=400, threads=1, samples_per_step=1 << 14)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made, root = scene(), tmp_path_factory.mktemp("room")
    made.make(root, "room", made.Views(train=48, test=2, size=48, distance=2.4, angle_deg=40.0))
    return root


def quality(room: Path) -> float:
    """PSNR in dB of the held-out views."""
    return float(
        np.mean(from_dataset.train_field(room, room / "room.safetensors", None, "auto", HOW, SMALL).test_psnr_db)
    )


def test_a_room_is_learnt_whose_walls_lie_on_the_faces_of_its_box(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    learnt = quality(room)
    with monkeypatch.context() as patched:
        patched.setattr(from_dataset, "EDGE", 0.0)
        assert quality(room) < learnt - 2
    with monkeypatch.context() as patched:
        patched.setattr(training, "LATE", 0.0)
        assert quality(room) < learnt - 3


def test_a_box_that_all_images_end_in_grows_and_that_of_an_object_does_not(room: Path, tmp_path: Path) -> None:
    space = from_dataset.space_of(load_dataset(room, "train"))
    half = np.array([3.2, 3.2, 2.1]) + 3.2 * from_dataset.EDGE
    assert space.scale == pytest.approx(half[0])
    np.testing.assert_allclose(np.array(space.half) * space.scale, half)
    np.testing.assert_allclose(space.centre, (0, 0, 0.9))
    posed_images.write_blender(tmp_path, posed_images.centred(24, 24, 30.0))
    dataset = load_dataset(tmp_path, "train")
    aabb = dataset.bounds.aabb
    assert from_dataset.space_of(dataset).scale == pytest.approx(float((aabb[1] - aabb[0]).max()) / 2)


@dataclass(frozen=True)
class Learnt:
    """What `finished` asks of a learner, of a field whose density is 1 everywhere: 0.5 % of a step's light is lost."""

    config: TrainingConfig
    hazy: Field

    def field(self, metadata: FieldMetadata) -> Field:
        return self.hazy

    def densities(self, u: np.ndarray) -> np.ndarray:
        return np.ones(len(u), np.float32)


@pytest.mark.parametrize("image_shows_it", [True, False])
def test_haze_is_cut_out_only_where_no_view_shows_the_difference(image_shows_it: bool) -> None:
    metadata = FieldMetadata(Space(False, (0.0, 0.0, 0.0), 1.0, step=2 / 384), SMALL, (0.0, 0.0, 0.0), [], "test", "")
    net = new_net(SMALL, np.random.default_rng(0))
    hazy = Field(metadata, net._replace(table=np.zeros_like(net.table)), np.ones((64, 64, 64), bool))
    camera, pose = (
        Camera(48, 48, 60.0, 60.0, 23.5, 23.5),
        look_at(np.array([0, -3.0, 1]), np.zeros(3), np.array([0, 0, 1.0])),
    )
    shown = NumbaRenderer(hazy).render_view(camera, pose)
    assert shown.opacity.max() > 0.8
    image = shown.rgb if image_shows_it else np.zeros_like(shown.rgb)
    learner = cast(training.Learner, Learnt(TrainingConfig(threads=1), hazy))
    cut = from_dataset.finished(learner, metadata, [View("0", image, camera, pose)])
    assert cut.occupied.any() == image_shows_it
