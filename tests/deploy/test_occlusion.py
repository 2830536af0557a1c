"""Things pasted over images cover what is wanted, and nothing else changes."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.posed_images import centred, write_blender

from fieldpose.deploy.evaluation.occlusion import Occlusion, objects_of, occluded, painted
from fieldpose.deploy.scene import demo_file
from fieldpose.errors import DatasetError
from fieldpose.stages.nerf.datasets import load_dataset

GREY = np.full((120, 160, 3), 99, np.uint8)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.05, 0.5))
def test_what_is_not_covered_stays_as_it_was(seed: int, share: float) -> None:
    wanted = Occlusion(covered=(share, share))
    image, hidden = occluded(GREY, np.random.default_rng(seed), painted, wanted)
    again, _ = occluded(GREY, np.random.default_rng(seed), painted, wanted)
    np.testing.assert_array_equal(image, again)
    assert image.dtype == np.uint8
    changed = (image != GREY).any(axis=2)
    assert hidden.any()
    assert changed[hidden].mean() > 0.9
    near = cv2.dilate(hidden.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    assert not (changed & ~near).any()  # beside what is hidden there is only the half-transparent rim


def test_at_least_the_wanted_share_is_covered() -> None:
    shares = [occluded(GREY, np.random.default_rng(i), painted, Occlusion((0.3, 0.3)))[1].mean() for i in range(20)]
    assert min(shares) >= 0.3
    assert np.mean(shares) < 0.6


def test_edges_mix_with_the_image_and_nothing_else() -> None:
    """A white thing on a white image leaves no trace, whatever colour its transparent pixels have."""
    thing = np.zeros((64, 64, 4), np.uint8)
    thing[16:48, 16:48] = 255
    white = np.full((120, 160, 3), 255, np.uint8)
    image, hidden = occluded(white, np.random.default_rng(3), lambda rng: thing)
    assert hidden.any()
    assert image.min() >= 254


def test_objects_are_cut_out_of_a_dataset(tmp_path: Path) -> None:
    write_blender(tmp_path, centred(40, 40, 50.0))
    dataset = load_dataset(tmp_path, "test")
    thing = objects_of(dataset)(np.random.default_rng(0))
    assert thing.shape[2] == 4
    assert thing[[0, -1], :, 3].any(axis=1).all()
    assert thing[:, [0, -1], 3].any(axis=0).all()
    image, hidden = occluded(GREY, np.random.default_rng(1), objects_of(dataset))
    assert hidden.any()
    assert (image[hidden] != 99).any()


def test_a_dataset_without_transparency_has_nothing_to_cut_out() -> None:
    dataset = load_dataset(demo_file("transforms_test.json").parent, "test")
    with pytest.raises(DatasetError, match="cut out by their transparency"):
        objects_of(dataset)
