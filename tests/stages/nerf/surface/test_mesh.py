"""Triangles and points: areas, normals, pieces, thinning."""

from __future__ import annotations

import numpy as np
import pytest

from fieldpose.stages.nerf.surface.mesh import areas, pieces_of_share, vertex_normals, without_unused
from fieldpose.stages.nerf.surface.thinning import one_a_cube, thinned

POINTS = np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0], [5, 0, 0], [5.1, 0, 0], [5, 0.1, 0], [9, 9, 9]], float)
TRIANGLES = np.array([[0, 1, 2], [3, 4, 5]])


def test_areas_and_normals_by_hand() -> None:
    np.testing.assert_allclose(areas(POINTS, TRIANGLES), [2, 0.005])
    np.testing.assert_allclose(vertex_normals(POINTS, TRIANGLES), np.tile((0.0, 0.0, 1.0), (7, 1)))
    np.testing.assert_allclose(vertex_normals(POINTS, TRIANGLES[:, ::-1])[:6, 2], -1)


@pytest.mark.parametrize(("least", "kept"), [(0.0, 2), (0.0024, 2), (0.003, 1), (1.0, 1)])
def test_pieces_are_kept_by_their_share_of_the_largest(least: float, kept: int) -> None:
    assert pieces_of_share(POINTS, TRIANGLES, least).sum() == kept
    assert pieces_of_share(POINTS, TRIANGLES[:0], least).shape == (0,)


def test_points_without_a_triangle_go() -> None:
    used, triangles = without_unused(TRIANGLES[1:], 7)
    np.testing.assert_array_equal(used, [3, 4, 5])
    np.testing.assert_array_equal(triangles, [[0, 1, 2]])


def test_a_cube_has_the_weighted_mean_of_its_points_whichever_part_they_come_in() -> None:
    rng = np.random.default_rng(0)
    points, normals, weights = rng.uniform(-1, 1, (500, 3)), rng.normal(size=(500, 3)), rng.uniform(0.1, 1, 500)
    at_once = one_a_cube([(points, normals, weights)], 0.5)
    parts = [(points[i::40], normals[i::40], weights[i::40]) for i in range(40)]
    np.testing.assert_allclose(one_a_cube(parts, 0.5), at_once)
    assert len(at_once) == 4**3
    mine = (np.floor(points / 0.5) == (0, -1, 1)).all(axis=1)
    expected = np.average(points[mine], axis=0, weights=weights[mine])
    assert np.abs(at_once[:, :3] - expected).max(axis=1).min() < 1e-12
    assert one_a_cube([], 0.5).shape == (0, 6)


def test_thinning_takes_as_many_as_wanted() -> None:
    points = np.random.default_rng(0).uniform(0, 1, (2000, 3))
    chosen = thinned(points, 100, 0.01, np.random.default_rng(1))
    assert len(np.unique(chosen)) == 100
    np.testing.assert_array_equal(thinned(points, 3000, 0.01, np.random.default_rng(1)), np.arange(2000))
