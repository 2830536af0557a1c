"""Cameras found from nothing but what images share, against cameras that are known."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from support.papered_room import cameras_around, cameras_before_a_wall, photograph, shared, worst

from fieldpose.stages.geometry import Camera
from fieldpose.stages.structure.features import Keypoints, find_keypoints
from fieldpose.stages.structure.mapping import map_images, overlap
from fieldpose.stages.structure.pairs import alike_pairs
from fieldpose.stages.structure.posed import PosedCameras
from fieldpose.stages.structure.similarity import align
from fieldpose.stages.structure.tracks import Tracks

TRUE = Camera(640, 480, 560.0, 560.0, 319.5, 239.5, (-0.06, 0.0, 0.0, 0.0, 0.0))
GUESS = Camera(640, 480, 768.0, 768.0, 319.5, 239.5)
NO_DESCRIPTORS = np.zeros((0, 128), np.uint8)


def as_matches(tracks: Tracks, images: int) -> tuple[list[Keypoints], list[tuple[int, int]], list[np.ndarray]]:
    """Tracks as keypoints and matches of pairs, as matchers give them."""
    place = np.zeros(len(tracks.image), np.int64)
    keypoints = []
    for i in range(images):
        mine = np.flatnonzero(tracks.image == i)
        place[mine] = np.arange(len(mine))
        keypoints.append(Keypoints(tracks.pixels[mine], NO_DESCRIPTORS))
    pairs, matches = [], []
    for i in range(images):
        for j in range(i + 1, images):
            first, second = (
                {int(t): int(p) for t, p in zip(tracks.track[s], place[s], strict=True)}
                for s in (tracks.image == i, tracks.image == j)
            )
            both = sorted(first.keys() & second.keys())
            pairs.append((i, j))
            matches.append(np.array([(first[t], second[t]) for t in both], np.int64).reshape(-1, 2))
    return keypoints, pairs, matches


@pytest.mark.parametrize("focal_known", [False, True])
def test_cameras_are_found_up_to_a_similarity(focal_known: bool) -> None:
    truth = cameras_before_a_wall(TRUE, 12)
    keypoints, pairs, matches = as_matches(shared(truth, 800, noise_px=0.2, wrong=0.02), 12)
    guess = msgspec.structs.replace(GUESS, fx=550.0, fy=550.0) if focal_known else GUESS
    told: list[float] = []
    found = map_images(keypoints, pairs, matches, guess, focal_known, 1, told.append)
    assert found is not None
    assert found.index.tolist() == list(range(12))
    similarity = align(found.cam_from_object, truth.cam_from_object)
    aligned = PosedCameras(truth.cameras, similarity.of_poses(found.cam_from_object))
    degrees, length = worst(aligned, truth)
    assert degrees < 0.3
    assert length < 0.02
    assert found.camera.fx == pytest.approx(560, rel=5e-3)
    assert found.camera.distortion[0] == pytest.approx(-0.06, abs=0.01)
    assert found.error_px < 0.5
    assert len(found.seen) == 12
    assert found.seen.min() > 30
    assert told == sorted(told)
    assert told[-1] == 1.0
    walls = np.abs(similarity.of_points(found.points)).max(axis=1)
    assert np.median(np.abs(walls - 2.0)) < 0.02


def test_of_two_places_the_one_with_more_images_is_given() -> None:
    here, there = cameras_before_a_wall(TRUE, 10), cameras_before_a_wall(TRUE, 6, seed=8)
    first, second = as_matches(shared(here, 500, 0.2), 10), as_matches(shared(there, 500, 0.2, seed=4), 6)
    pairs = first[1] + [(i + 10, j + 10) for i, j in second[1]]
    found = map_images(first[0] + second[0], pairs, first[2] + second[2], GUESS, False, 1)
    assert found is not None
    assert set(found.index.tolist()) <= set(range(10))
    assert overlap(17, pairs, first[2] + second[2]).tolist() == [True] * 16 + [False]


def test_images_that_share_nothing_have_no_cameras() -> None:
    keypoints = [Keypoints(np.random.default_rng(i).uniform(0, 400, (200, 2)), NO_DESCRIPTORS) for i in range(4)]
    pairs = [(0, 1), (1, 2), (2, 3)]
    assert map_images(keypoints, pairs, [np.zeros((0, 2), np.int64)] * 3, GUESS, False, 1) is None


def test_what_looks_alike_is_matched() -> None:
    camera = Camera(480, 360, 400.0, 400.0, 239.5, 179.5)
    truth = cameras_around(camera, 18)
    keypoints = [find_keypoints(photograph(camera, pose), 600) for pose in truth.cam_from_object]
    pairs = alike_pairs(keypoints, 6)
    near = [(i, j) for i in range(18) for j in range(i + 1, 18) if min(j - i, 18 - j + i) <= 2]
    assert len(set(near) & set(pairs)) > 0.9 * len(near)
    assert len(pairs) < 0.6 * 18 * 17 / 2
    assert pairs == sorted(set(pairs))
    assert all(0 <= i < j < 18 for i, j in pairs)
    assert all(i < j for i, j in alike_pairs(keypoints[:4], 6))
