"""Marching cubes: the surface of what is known by a formula, and that pieces fit together."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.surfaces import is_closed, volume

from fieldpose.stages.nerf.surface.marching import Piece, isosurface, joined
from fieldpose.stages.nerf.surface.mesh import vertex_normals

N = 33
MIDDLE = (N - 1) / 2
Distance = Callable[[np.ndarray], np.ndarray]


def ball(p: np.ndarray) -> np.ndarray:
    return np.linalg.norm(p, axis=-1) - 11.0


def torus(p: np.ndarray) -> np.ndarray:
    return np.hypot(np.hypot(p[..., 0], p[..., 1]) - 9.0, p[..., 2]) - 4.0


def sampled(distance: Distance, n: int = N) -> np.ndarray:
    """Values (1, n, n, n) at nodes, [z, y, x]."""
    z, y, x = np.meshgrid(*3 * [np.arange(n) - MIDDLE], indexing="ij")
    return distance(np.stack([x, y, z], axis=-1)).astype(np.float32)[None]


def whole(values: np.ndarray, known: np.ndarray | None = None) -> Piece:
    n = values.shape[1]
    everywhere = np.ones_like(values, bool) if known is None else known
    return isosurface(values, everywhere, np.zeros((1, 3), np.int64), (n, n, n))


@pytest.mark.parametrize(
    ("shape", "size"), [(ball, 4 / 3 * np.pi * 11**3), (torus, 2 * np.pi**2 * 9 * 4**2)], ids=["ball", "torus"]
)
def test_the_surface_of_a_formula_is_near_it_closed_and_faces_outwards(shape: Distance, size: float) -> None:
    piece = whole(sampled(shape))
    points = piece.vertices - MIDDLE
    assert np.abs(shape(points)).max() < 0.04
    assert is_closed(piece.triangles)
    assert volume(points, piece.triangles) == pytest.approx(size, rel=0.02)
    normals = vertex_normals(points, piece.triangles)
    rising = (shape(points + 1e-3 * normals) - shape(points - 1e-3 * normals)) / 2e-3
    assert rising.min() > 0.97


def test_a_torus_has_one_hole() -> None:
    piece = whole(sampled(torus))
    edges = 3 * len(piece.triangles) // 2
    assert len(piece.vertices) - edges + len(piece.triangles) == 0


@given(st.integers(0, 2**32 - 1))
def test_whatever_the_values_the_surface_is_closed_within_a_border_outside(seed: int) -> None:
    values = np.ones((1, 7, 7, 7), np.float32)
    values[0, 1:-1, 1:-1, 1:-1] = np.random.default_rng(seed).choice([-1.0, -0.2, 0.0, 0.3, 1.0], (5, 5, 5))
    assert is_closed(whole(values).triangles)


def test_blocks_give_the_surface_of_the_whole() -> None:
    values, n = sampled(torus), N // 2 + 1
    starts = np.array([(x, y, z) for x in (0, n - 1) for y in (0, n - 1) for z in (0, n - 1)])
    pieces = []
    for x, y, z in starts:
        block = values[:, z : z + n, y : y + n, x : x + n]
        pieces.append(isosurface(block, np.ones_like(block, bool), np.array([(x, y, z)]), (N, N, N)))
    vertices, triangles = joined(pieces)
    expected = whole(values)
    np.testing.assert_array_equal(vertices, expected.vertices)
    assert len(triangles) == len(expected.triangles)
    assert is_closed(triangles)


def test_where_a_corner_is_not_known_there_is_no_surface() -> None:
    values = sampled(ball)
    known = np.ones_like(values, bool)
    known[:, :, :, : N // 2] = False
    piece = whole(values, known)
    assert piece.vertices[:, 0].min() >= N // 2
    assert not is_closed(piece.triangles)
    assert len(whole(values, np.zeros_like(known)).triangles) == 0
    assert len(joined([])[1]) == 0
