"""How much of an object's outline a field shows."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from support import posed_images as made

from fieldpose.deploy.benchmarks.coverage import silhouette_coverage
from fieldpose.stages.geometry import Camera
from fieldpose.stages.nerf.datasets import Dataset, load_dataset
from fieldpose.stages.nerf.rendering_api import RenderedView


@dataclass
class Shows:
    """Renders the dataset's images one after the other, with some of their opacity and at so many times the depth."""

    dataset: Dataset
    opacity: float = 1.0
    depth: float = 1.0
    index: int = 0

    def render_view(self, camera: Camera, cam_from_object: np.ndarray) -> RenderedView:
        pixels = self.dataset.load_image(self.index)
        alpha = pixels[..., 3] / 255 if self.dataset.has_alpha else np.ones(pixels.shape[:2])
        truth = np.zeros(pixels.shape[:2]) if self.dataset.has_alpha else self.dataset.load_depth(self.index)
        self.index += 1
        depth, opacity = (self.depth * truth).astype(np.float32), (self.opacity * alpha).astype(np.float32)
        return RenderedView(pixels[..., :3], depth, opacity, camera, cam_from_object)


@pytest.mark.parametrize(("opacity", "expected"), [(1.0, 1.0), (0.25, 0.25), (0.0, 0.0)])
def test_by_alpha_what_is_half_there_counts_by_half(tmp_path: Path, opacity: float, expected: float) -> None:
    made.write_blender(tmp_path, made.centred(24, 24, 30.0))
    dataset = load_dataset(tmp_path, "test")
    assert silhouette_coverage(Shows(dataset, opacity), dataset) == pytest.approx(expected)  # type: ignore[arg-type]


@pytest.mark.parametrize(("depth", "expected"), [(1.0, 1.0), (1.04, 1.0), (1.1, 0.0)])
def test_by_mask_the_depth_has_to_be_the_objects(tmp_path: Path, depth: float, expected: float) -> None:
    made.write_blender(tmp_path, made.centred(24, 24, 30.0), channels=3, counts=(3, 1))
    made.edit_json(tmp_path / "transforms_train.json", aabb=[[-1, -1, -1], [1, 1, 1]])
    made.edit_frame(
        tmp_path / "transforms_test.json", 0, depth_file_path="depth.npy", mask_file_path="mask.png", depth_scale=1.0
    )
    np.save(tmp_path / "depth.npy", np.full((24, 24), 3.0, np.float32))
    made.save(tmp_path / "mask.png", np.pad(np.full((10, 10), 255, np.uint8), 7))
    dataset = load_dataset(tmp_path, "test")
    assert silhouette_coverage(Shows(dataset, depth=depth), dataset) == expected  # type: ignore[arg-type]


def test_without_an_outline_there_is_none(tmp_path: Path) -> None:
    made.write_blender(tmp_path, made.centred(24, 24, 30.0), channels=3)
    made.edit_json(tmp_path / "transforms_train.json", aabb=[[-1, -1, -1], [1, 1, 1]])
    dataset = load_dataset(tmp_path, "test")
    assert silhouette_coverage(Shows(dataset), dataset) is None  # type: ignore[arg-type]
