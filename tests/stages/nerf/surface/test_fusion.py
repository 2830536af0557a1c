"""Views of known shapes fused: where the surface comes to lie, and the kernels against plain twins."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from support.surfaces import RED, around, is_closed, views_of, volume

from fieldpose.stages.geometry import Camera, look_at
from fieldpose.stages.nerf.surface.extract import Region, surface_mesh, surface_points
from fieldpose.stages.nerf.surface.fusion import REACH, fused, grid_over
from fieldpose.stages.nerf.surface.kernels import DepthViews, fuse
from fieldpose.stages.nerf.surface.views import agreement, normals_of

BOX = np.array([[-1.1, -1.1, -1.1], [1.1, 1.1, 1.1]])
CELL = 2.2 / 44


def ball(p: np.ndarray) -> np.ndarray:
    return np.linalg.norm(p, axis=-1) - 1.0


def plate(p: np.ndarray) -> np.ndarray:
    """Three cells thick."""
    outside = np.abs(p) - (0.8, 0.8, 1.5 * CELL)
    return np.linalg.norm(np.maximum(outside, 0), axis=-1) + np.minimum(outside.max(axis=-1), 0)


def two_balls(p: np.ndarray) -> np.ndarray:
    return np.minimum(np.linalg.norm(p - (-0.3, 0, 0), axis=-1) - 0.6, np.linalg.norm(p - (0.8, 0, 0), axis=-1) - 0.12)


@pytest.fixture(scope="module")
def balls() -> DepthViews:
    return views_of(ball, around(24))


def projected(views: DepthViews, v: int, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """In the camera (n, 3), pixels (n, 2), and which are in the image."""
    in_cam = points @ views.turn[v].T + views.shift[v]
    pixel = in_cam[:, :2] / in_cam[:, 2:] * views.lens[v, :2] + views.lens[v, 2:]
    return in_cam, pixel, ((pixel > -0.5) & (pixel < views.size[v] - 0.5)).all(axis=1) & (in_cam[:, 2] > 0)


def plain_depth(depth: np.ndarray, pixel: np.ndarray, jump: float) -> tuple[float, float]:
    """At a pixel, and the least around it."""
    row, column = (int(np.clip(np.floor(value), 0, 94)) for value in pixel[::-1])
    four = depth[row : row + 2, column : column + 2].astype(np.float64)
    if four.min() > 0 and np.isfinite(four).all() and np.ptp(four) < jump:
        x, y = pixel[0] - column, pixel[1] - row
        return float(np.array([1 - y, y]) @ four @ np.array([1 - x, x])), four.min()
    return float(depth[int(pixel[1] + 0.5), int(pixel[0] + 0.5)]), four.min()


def plain_fused(views: DepthViews, points: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """The weighted mean of truncated signed distances at points, and the weights, as fuse should have them."""
    total, weights = np.zeros(len(points)), np.zeros(len(points))
    for v in range(len(views.depth)):
        in_cam, pixel, inside = projected(views, v, points)
        for q in np.flatnonzero(inside):
            cosine = views.facing[v][tuple((pixel[q, ::-1] + 0.5).astype(int))] / 255
            seen, least = plain_depth(views.depth[v], pixel[q], reach)
            if seen <= 0:
                continue
            slant = np.linalg.norm(in_cam[q]) / in_cam[q, 2]
            distance = (seen - in_cam[q, 2]) * cosine * slant / reach if cosine > 0 else 0.0
            if distance > -1 and not (distance > 1 and least < in_cam[q, 2] + reach):
                weight = cosine**2 / in_cam[q, 2] ** 2 * (1 + min(distance, 0))
                total[q] += weight * min(distance, 1)
                weights[q] += weight
    return np.divide(total, weights, out=np.zeros(len(points)), where=weights > 0), weights


def test_the_kernel_fuses_as_its_plain_twin(balls: DepthViews) -> None:
    start, n, reach = np.array([[14, 3, 20]]), 5, REACH * CELL
    value, weight = np.empty((1, n, n, n), np.float32), np.empty((1, n, n, n), np.float32)
    low = BOX[0].astype(np.float32)
    fuse(balls, start, low, np.float32(CELL), np.float32(reach), value, weight)
    z, y, x = np.meshgrid(*3 * [np.arange(n)], indexing="ij")
    nodes = BOX[0] + CELL * (np.stack([x, y, z], axis=-1).reshape(-1, 3) + start)
    expected, weights = plain_fused(balls, nodes, reach)
    assert (weights > 0).sum() > 40
    assert len(np.unique(np.sign(expected))) > 1
    # A pixel is chosen by rounding, which single precision may do otherwise at a border.
    assert np.quantile(np.abs(value.ravel() - expected), 0.95) < 1e-3
    assert np.quantile(np.abs(weight.ravel() - weights), 0.95) < 1e-3


def test_a_node_is_the_same_in_every_block(balls: DepthViews) -> None:
    starts = np.array([[0, 16, 16], [16, 16, 16]])
    value, weight = np.empty((2, 17, 17, 17), np.float32), np.empty((2, 17, 17, 17), np.float32)
    fuse(balls, starts, BOX[0].astype(np.float32), np.float32(CELL), np.float32(2 * CELL), value, weight)
    np.testing.assert_array_equal(value[0, :, :, 16], value[1, :, :, 0])
    np.testing.assert_array_equal(weight[0, :, :, 16], weight[1, :, :, 0])


def test_what_views_say_is_as_the_plain_twin_has_it(balls: DepthViews) -> None:
    rng, tolerance = np.random.default_rng(0), 0.04
    points = rng.normal(size=(300, 3))
    points *= (rng.choice([0.9, 1.0, 1.3], 300) / np.linalg.norm(points, axis=1))[:, None]
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    said = agreement(balls, points, normals, tolerance)
    seen, past = np.zeros(300), np.zeros(300)
    for v in range(len(balls.depth)):
        in_cam, pixel, inside = projected(balls, v, points)
        towards = -np.einsum("ij,ij->i", normals @ balls.turn[v].T, in_cam) / np.linalg.norm(in_cam, axis=1)
        for q in np.flatnonzero(inside):
            depth, least = plain_depth(balls.depth[v], pixel[q], tolerance)
            weight = 1 / in_cam[q, 2] ** 2
            past[q] += weight * (min(depth, least) > in_cam[q, 2] + tolerance)
            seen[q] += weight * towards[q] ** 2 * (abs(depth - in_cam[q, 2]) <= tolerance and towards[q] > 0)
    np.testing.assert_allclose(said.seen, seen, atol=2e-3)
    assert np.quantile(np.abs(said.past - past), 0.98) < 2e-3
    on = np.isclose(np.linalg.norm(points, axis=1), 1)
    assert said.agreed[on].mean() > 0.98
    assert not said.agreed[~on].any()
    assert (said.colours[said.agreed] == RED).all()


def test_a_ball_comes_out_as_a_ball(balls: DepthViews) -> None:
    vertices, triangles = fused(balls, grid_over(BOX, 44), threads=2)
    assert is_closed(triangles)
    assert np.abs(ball(vertices)).max() < 0.35 * CELL
    assert np.abs(ball(vertices)).mean() < 0.07 * CELL
    assert volume(vertices, triangles) == pytest.approx(4 / 3 * np.pi, rel=0.01)
    mesh = surface_mesh(balls, Region(BOX), 44, 0.001)
    assert np.einsum("ij,ij->i", mesh.normals, mesh.points).min() > 0.94
    assert (mesh.colours == RED).all()
    assert len(mesh.triangles) > 0.99 * len(triangles)


def test_a_thin_plate_keeps_its_two_sides_where_they_are() -> None:
    mesh = surface_mesh(views_of(plate, around(30)), Region(BOX), 44, 0.001)
    inner = np.abs(mesh.points[:, :2]).max(axis=1) < 0.6
    assert np.abs(np.abs(mesh.points[inner, 2]) - 1.5 * CELL).max() < 0.35 * CELL
    assert (mesh.points[inner, 2] > 0).mean() == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize(("share", "least_x", "most_x"), [(0.001, 0.9, 0.95), (0.5, 0.25, 0.35)])
def test_small_pieces_are_left_out(share: float, least_x: float, most_x: float) -> None:
    mesh = surface_mesh(views_of(two_balls, around(24)), Region(BOX), 44, share)
    assert least_x < mesh.points[:, 0].max() < most_x


def test_a_region_ends_the_mesh_and_the_points(balls: DepthViews) -> None:
    half = Region(np.array([[-1.1, -1.1, 0.2], [1.1, 1.1, 1.1]]))
    for surface in (surface_mesh(balls, half, 44, 0.001), surface_points(balls, half, CELL)):
        assert surface.points[:, 2].min() > 0.15
        assert len(surface.points) > 500
    nowhere = Region(np.array([[-0.2, -0.2, -0.2], [0.2, 0.2, 0.2]]))
    assert len(surface_mesh(balls, nowhere, 20, 0.001).points) == 0
    assert len(surface_points(balls, nowhere, CELL).points) == 0


def test_points_are_on_the_surface_and_as_many_as_wanted(balls: DepthViews) -> None:
    cloud = surface_points(balls, Region(BOX), CELL)
    assert np.abs(ball(cloud.points)).max() < 0.25 * CELL
    assert np.einsum("ij,ij->i", cloud.normals, cloud.points).min() > 0.95
    few = surface_points(balls, Region(BOX), CELL, count=200)
    assert len(few.points) == 200
    apart = np.linalg.norm(few.points[:, None] - few.points[None], axis=-1) + 9 * np.eye(200)
    assert np.median(apart.min(axis=1)) > 2 * CELL
    assert len(surface_points(balls, Region(BOX), CELL, count=10**9).points) == len(cloud.points)


@pytest.mark.parametrize("slant", [0.0, 0.7])
def test_normals_of_a_plane_and_none_without_neighbours(slant: float) -> None:
    camera = Camera(20, 16, 30.0, 30.0, 9.5, 7.5)
    normal = np.array([np.sin(slant), 0, -np.cos(slant)])
    depth = (2 * normal[2] / (camera.directions(camera.grid()) @ normal)).reshape(16, 20).astype(np.float32)
    np.testing.assert_allclose(normals_of(camera, depth), np.broadcast_to(normal, (16, 20, 3)), atol=1e-4)
    alone = np.zeros_like(depth)
    alone[5, 5] = 2
    assert not normals_of(camera, alone).any()


def plain_views(distance: Callable[[np.ndarray], np.ndarray]) -> DepthViews:
    return views_of(distance, [look_at((0, 0, 4), (0, 0, 0), (0, 1, 0))])


def test_where_no_view_has_looked_the_surface_is_open() -> None:
    mesh = surface_mesh(plain_views(ball), Region(BOX), 44, 0.001)
    assert len(mesh.points) > 300
    assert mesh.points[:, 2].min() > 0
    assert not is_closed(mesh.triangles)
