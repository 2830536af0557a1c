"""Opaque images of an object on one colour: told from scenes, and that colour is not learnt."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import posed_images

from fieldpose.stages.nerf.config import FieldConfig
from fieldpose.stages.nerf.datasets import load_dataset
from fieldpose.stages.nerf.datasets.images import plain_background
from fieldpose.stages.nerf.from_dataset import metadata_of, views_of
from fieldpose.stages.nerf.raybank import RayBank


def photo(colour: tuple[int, int, int], seed: int, size: int = 40) -> np.ndarray:
    """A speckled object in the middle of one colour, with a little noise."""
    rng = np.random.default_rng(seed)
    image = np.clip(np.array(colour) + rng.integers(-2, 3, (size, size, 3)), 0, 255)
    image[10:30, 12:28] = rng.integers(0, 256, (20, 16, 3))
    return image.astype(np.uint8)


def found(*images: np.ndarray) -> tuple[int, int, int] | None:
    return plain_background([partial(np.copy, image) for image in images])


@given(st.tuples(*[st.integers(0, 255)] * 3), st.integers(0, 1000))
def test_one_colour_around_all_is_found(colour: tuple[int, int, int], seed: int) -> None:
    result = found(photo(colour, seed), photo(colour, seed + 1))
    assert result is not None
    assert np.abs(np.subtract(result, colour)).max() <= 2


def test_what_is_no_plain_background() -> None:
    white, grey = photo((255, 255, 255), 0), photo((90, 90, 90), 0)
    assert found(white, grey) is None
    ramp = np.broadcast_to(np.linspace(0, 255, 40).astype(np.uint8)[:, None], (40, 40, 3))
    assert found(ramp) is None
    assert found(np.full((40, 40, 3), 255, np.uint8)) is None
    assert found() is None


def test_no_image_is_loaded_after_one_that_differs() -> None:
    def loaded() -> np.ndarray:
        raise AssertionError

    ramp = np.broadcast_to(np.linspace(0, 255, 40).astype(np.uint8)[:, None], (40, 40, 3))
    assert plain_background([lambda: ramp, loaded]) is None


@pytest.mark.parametrize("colour", [(255, 255, 255), (0, 0, 0), (20, 160, 60)])
def test_a_dataset_on_a_plain_background_is_an_object(tmp_path: Path, colour: tuple[int, int, int]) -> None:
    posed_images.write_blender(tmp_path, posed_images.centred(40, 40, 40.0), channels=3)
    for i, path in enumerate(sorted(tmp_path.rglob("*.png"))):
        posed_images.save(path, photo(colour, i))
    dataset = load_dataset(tmp_path)
    assert (dataset.scene, dataset.has_alpha) == ("object", False)
    assert dataset.background is not None
    assert np.abs(np.subtract(dataset.background, colour)).max() <= 2
    assert any("plain background" in note for note in dataset.notes)
    views = views_of(dataset)
    metadata = metadata_of(dataset, views, FieldConfig())
    assert not metadata.has_background
    np.testing.assert_allclose(metadata.background, np.array(dataset.background) / 255)
    batch = RayBank(views, metadata.space).draw(np.random.default_rng(0), 50)
    np.testing.assert_allclose(batch.background, np.tile(metadata.background, (50, 1)), atol=1e-6)
