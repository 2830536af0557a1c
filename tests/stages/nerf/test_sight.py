"""Which part of a view's rays is traced: all that can meet anything, and little else."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldpose.stages.geometry import Camera, exp_se3, look_at, rays
from fieldpose.stages.nerf.config import FieldConfig
from fieldpose.stages.nerf.field import Field, new_net
from fieldpose.stages.nerf.kernels.sight import block_centres, block_radius, tile_limits
from fieldpose.stages.nerf.metadata import FieldMetadata, Space
from fieldpose.stages.nerf.renderer import NumbaRenderer

BOX = Space(False, (0.1, -0.2, 0.3), 1.5, half=(1.0, 0.8, 0.9), step=0.03)
CONFIG = FieldConfig(
    levels=3, log2_table=9, finest_resolution=64, hidden=16, features=6, colour_hidden=8, occupancy_resolution=32
)
TILE = 8


def sparse_field(fill: float, seed: int) -> Field:
    rng = np.random.default_rng(seed)
    net = new_net(CONFIG, rng)
    net.table[:] = rng.normal(0, 0.7, net.table.shape)
    metadata = FieldMetadata(BOX, CONFIG, (1.0, 0.5, 0.0), [], "test", "")
    return Field(metadata, net, rng.random((32, 32, 32)) < fill)


def some_camera(rng: np.random.Generator) -> tuple[Camera, np.ndarray]:
    """Far away, near, or within the box; looking at it or past it; sizes that are no multiple of a tile."""
    width, height = rng.integers(9, 70, 2)
    focal = rng.uniform(0.4, 2.0) * width
    cx, cy = rng.uniform(-0.5, 1.5, 2) * (width, height)
    camera = Camera(int(width), int(height), focal, 1.1 * focal, cx, cy)
    eye = rng.normal(size=3) * rng.choice([0.3, 1.5, 5.0])
    pose = look_at(eye, rng.normal(size=3) * rng.choice([0.1, 1.5]), (0.0, 0.0, 1.0))
    return camera, exp_se3([0, 0, 0, 0, 0, rng.uniform(-3, 3)]) @ pose


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 2e-4, 0.01, 0.3]))
def test_a_view_is_what_its_rays_are_one_by_one(seed: int, fill: float) -> None:
    rng = np.random.default_rng(seed)
    renderer, (camera, pose) = NumbaRenderer(sparse_field(fill, seed % 1000)), some_camera(rng)
    view, traced = renderer.render_view(camera, pose), renderer.render_rays(*rays(camera, pose))
    for whole, single, tolerance in (
        (view.opacity, traced.opacity, 2e-3), (view.depth, traced.depth, 5e-3),
        (view.rgb / 255.0, traced.rgb.reshape(*view.depth.shape, 3), 6e-3),
    ):  # fmt: skip
        different = (np.abs(whole - single.reshape(whole.shape)) > tolerance).reshape(view.depth.size, -1).any(axis=1)
        visible = max(int((traced.opacity > 0).sum()), 1)
        assert different.sum() <= 1 + 0.06 * visible  # a sample on the border of two cells may fall into either


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 12))
def test_limits_hold_every_ball_that_a_ray_meets(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    camera, pose = some_camera(rng)
    centres, radius = rng.uniform(-1, 1, (count, 3)).astype(np.float32), rng.uniform(0.02, 0.3)
    limits = limits_of(centres, radius, camera, pose)
    origins, directions = (values.astype(np.float64) for values in rays(camera, pose))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    x, y = camera.grid().astype(int).T
    near, far = limits[y // TILE, x // TILE].T
    for centre in centres:
        along = ((centre - origins) * directions).sum(axis=1)
        miss2 = ((centre - origins) ** 2).sum(axis=1) - along**2
        half = np.sqrt(np.maximum(radius**2 - miss2, 0))
        met = (miss2 < radius**2) & (along + half > 0)
        assert np.all(near[met] <= np.maximum(along - half, 0)[met] + 1e-5)
        assert np.all(far[met] >= (along + half)[met] - 1e-5)


def limits_of(centres: np.ndarray, radius: float, camera: Camera, pose: np.ndarray) -> np.ndarray:
    limits = np.empty((-(-camera.height // TILE), -(-camera.width // TILE), 2), np.float32)
    origin = -pose[:3, :3].T @ pose[:3, 3]
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    tile_limits(centres, radius, np.ascontiguousarray(pose[:3, :3]), origin, intrinsics, TILE, limits)
    return limits


def test_tiles_that_see_nothing_are_left_out() -> None:
    camera, pose = Camera(160, 120, 150.0, 150.0, 79.5, 59.5), look_at((0, 0, -4.0), (0, 0, 0), (0, 1, 0))
    limits = limits_of(np.zeros((1, 3), np.float32), 0.2, camera, pose)
    seen = limits[..., 1] > limits[..., 0]
    assert 4 <= seen.sum() <= 16
    assert seen[6:9, 9:11].any()
    assert limits[seen] == pytest.approx(np.tile([3.8, 4.2], (seen.sum(), 1)), abs=1e-5)
    assert not (limits_of(np.zeros((0, 3), np.float32), 0.2, camera, pose)[..., 1] > 0).any()


def test_the_centres_are_those_of_blocks_with_an_occupied_cell() -> None:
    field = sparse_field(0.0, 0)
    field.occupied[9, 2, 31] = True  # z, y, x
    assert block_centres(field.domain()) == pytest.approx(np.array([[0.875, -0.875, -0.375]]))
    assert block_radius(field.domain()) == pytest.approx(np.sqrt(3) * 4 / 32, rel=2e-3)
