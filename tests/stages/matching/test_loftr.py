"""LoFTR's weights are in no package: its path is tested with random ones, written by the test."""

from pathlib import Path

import numpy as np
import pytest
import torch
from kornia.feature import LoFTR
from support.pictures import picture

from fieldpose.bus.messages import Reason
from fieldpose.errors import WeightsError
from fieldpose.stages.matching.core import Matcher, MatchingConfig, PairMatcher, build_matcher

CELL = 8


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The published checkpoint's layout: names under `matcher.`, in `state_dict`."""
    torch.manual_seed(0)
    state = {f"matcher.{name}": value for name, value in LoFTR(None).state_dict().items()}
    path = tmp_path_factory.mktemp("loftr")
    torch.save({"state_dict": state}, path / "loftr_outdoor.ckpt")
    return path


@pytest.fixture(scope="module")
def matcher(folder: Path) -> Matcher:
    return build_matcher(MatchingConfig(matcher="loftr", weights=folder, min_confidence=1e-9))


def test_an_image_matches_itself_cell_by_cell(matcher: Matcher) -> None:
    image = picture(size=128)
    matched = matcher.match(matcher.extract(image), matcher.extract(image))
    assert len(matched.confidence) >= 20
    assert np.abs(matched.pixels_a - matched.pixels_b).max() <= CELL / 2
    np.testing.assert_allclose((matched.pixels_a + 0.5) % CELL, 0, atol=1e-4)
    assert ((matched.confidence >= 0) & (matched.confidence <= 1)).all()


def test_masks_and_sizes_are_respected(matcher: Matcher) -> None:
    image, mask = picture(size=128), np.zeros((128, 128), bool)
    mask[:, 64:] = True
    frame = matcher.extract(np.ascontiguousarray(image[:104, :96]))
    matched = matcher.match(matcher.extract(image, mask), frame)
    assert len(matched.confidence) > 0
    assert (np.rint(matched.pixels_a[:, 0]) >= 64).all()
    assert (matched.pixels_b <= (95.5, 103.5)).all()


def test_random_weights_are_not_confident(folder: Path) -> None:
    config = MatchingConfig(matcher="loftr", weights=folder / "loftr_outdoor.ckpt")
    matched = PairMatcher(build_matcher(config), config).match(picture(0, 96), np.ones((96, 96)), picture(1, 96))
    assert matched is Reason.TOO_FEW_MATCHES


def test_weights_of_another_network_are_refused(tmp_path: Path) -> None:
    torch.save({"state_dict": {"backbone.conv1.weight": torch.zeros(3)}}, tmp_path / "loftr_outdoor.ckpt")
    with pytest.raises(WeightsError, match="does not fit LoFTR"):
        build_matcher(MatchingConfig(matcher="loftr", weights=tmp_path))


def test_without_weights_the_ways_to_get_them_are_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    with pytest.raises(WeightsError, match=r"--matching\.weights.*download of https://.*--matching\.allow-download"):
        build_matcher(MatchingConfig(matcher="loftr"))
