"""A frame found for cameras around things on a floor, however both lie."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fieldpose.stages.geometry import Similarity, camera_centres, look_at
from fieldpose.stages.structure.upright import dominant_plane, stand

RNG = np.random.default_rng(0)
FLOOR = np.concatenate([RNG.uniform(-2, 2, (300, 2)), RNG.normal(0, 0.003, (300, 1))], axis=1)
THING = np.array([0, 0, 0.4]) + RNG.normal(0, 0.12, (500, 3)).clip(-0.4, 0.4)
MIRRORED = THING[:20] * (1, 1, -1)
ANGLES = np.linspace(0, 5.0, 24)
POSES = np.stack(
    [look_at((3 * np.cos(a), 3 * np.sin(a), 1.5 + 0.3 * np.sin(3 * a)), (0, 0, 0.4), (0.1, 0, 1.0)) for a in ANGLES]
)


def laid(similarity: Similarity, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return similarity.of_poses(POSES), similarity.of_points(points)


@given(st.integers(0, 2**32 - 1), st.floats(0.01, 100.0))
@settings(max_examples=20, deadline=None)
def test_the_frame_is_the_same_however_the_map_lies(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    map_from_world = Similarity(scale, Rotation.random(random_state=seed).as_matrix(), rng.normal(0, 5, 3) * scale)
    points = np.concatenate([FLOOR, THING, MIRRORED])
    poses, placed = laid(map_from_world, points)
    standing = stand(poses, placed)
    assert standing.on_plane
    unit = float(np.median(np.linalg.norm(camera_centres(POSES) - (0, 0, 0.4), axis=1)))
    found = standing.object_from_map.of_points(map_from_world.of_points(FLOOR)) * unit
    assert np.abs(found[:, 2]).max() < 0.03
    origin = standing.object_from_map.of_points(map_from_world.of_points(np.zeros((1, 3))))[0] * unit
    assert np.linalg.norm(origin) < 0.05
    centres = camera_centres(standing.object_from_map.of_poses(poses)) * unit
    np.testing.assert_allclose(
        np.linalg.norm(centres, axis=1), np.linalg.norm(camera_centres(POSES), axis=1), atol=0.06
    )
    assert (centres[:, 2] > 1).all()
    assert centres[0, 0] > 0
    assert abs(centres[0, 1]) < 0.05


def test_without_a_floor_up_is_that_of_the_cameras() -> None:
    standing = stand(POSES, THING)
    assert not standing.on_plane
    moved = standing.object_from_map.of_poses(POSES)
    np.testing.assert_allclose(-moved[:, 1, :3].mean(axis=0)[:2], 0, atol=1e-9)
    assert stand(POSES, np.zeros((0, 3))).on_plane is False


def test_a_wall_behind_the_thing_is_no_floor() -> None:
    wall = np.stack([np.full(300, -2.0), *RNG.uniform(-2, 2, (2, 300))], axis=1)
    up = np.array([0, 0, 1.0])
    assert dominant_plane(np.concatenate([wall, THING]), camera_centres(POSES), up, 0.02) is None
    found = dominant_plane(np.concatenate([wall[:200], FLOOR, THING]), camera_centres(POSES), up, 0.02)
    assert found is not None
    np.testing.assert_allclose(found[0], up, atol=0.02)
    assert found[1] == pytest.approx(0, abs=0.01)


def test_nothing_is_below_a_floor() -> None:
    below = RNG.uniform((-2, -2, -1), (2, 2, -0.1), (400, 3))
    assert dominant_plane(np.concatenate([FLOOR, below]), camera_centres(POSES), np.array([0, 0, 1.0]), 0.02) is None
