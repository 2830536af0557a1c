"""The compiled kernels against the plain twin, in values and gradients, on random fields."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldpose.stages.geometry import Camera, look_at
from fieldpose.stages.nerf.config import FieldConfig
from fieldpose.stages.nerf.field import Field, domain_of, new_net
from fieldpose.stages.nerf.kernels.train import Gradients, train
from fieldpose.stages.nerf.metadata import FieldMetadata, Space
from fieldpose.stages.nerf.renderer import STOP_BELOW, NumbaRenderer
from fieldpose.stages.nerf.torch_renderer import TorchRenderer
from fieldpose.stages.nerf.twin import distortion_loss, twin_of
from fieldpose.stages.nerf.workers import Workers

BOX = Space(False, (0.1, -0.2, 0.3), 1.5, half=(1.0, 0.8, 0.9), step=0.03)
BALL = Space(True, (0.1, -0.2, 0.3), 1.5, near=0.05, far=20.0, step=0.06)
PART = Space(True, (0.1, -0.2, 0.3), 3.0, near=0.05, far=20.0, step=0.03, box=(-0.5, -0.5, -0.4, 0.6, 0.2, 0.6))
CONFIGS = {
    "wide": FieldConfig(
        levels=3, log2_table=9, finest_resolution=64, hidden=16, features=6, colour_hidden=8, occupancy_resolution=16
    ),
    "narrow": FieldConfig(
        levels=5, level_features=2, log2_table=8, base_resolution=4, finest_resolution=50, hidden=8, features=3,
        colour_hidden=16, occupancy_resolution=8,
    ),
}  # fmt: skip


def random_field(config: FieldConfig, space: Space, fill: float, seed: int) -> Field:
    rng = np.random.default_rng(seed)
    net = new_net(config, rng)
    net.table[:] = rng.normal(0, 0.7, net.table.shape)
    n = config.occupancy_resolution
    metadata = FieldMetadata(space, config, (1.0, 0.5, 0.0), [], "test", "")
    return Field(metadata, net, rng.random((n, n, n)) < fill)


def random_rays(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Some hit the middle, some miss, some start inside, some run along an axis."""
    rng = np.random.default_rng(seed)
    origins = rng.normal(0, 2.5, (count, 3)).astype(np.float32)
    directions = (rng.normal(0, 0.7, (count, 3)) - origins).astype(np.float32)
    directions[: count // 8] *= -1
    directions[-1] = (0, 0, 2)
    return origins, directions


@settings(max_examples=12, deadline=None)
@given(
    config=st.sampled_from(sorted(CONFIGS)), space=st.sampled_from([BOX, BALL, PART]),
    fill=st.sampled_from([0.0, 0.02, 0.3, 1.0]), seed=st.integers(0, 1000),
)  # fmt: skip
def test_renders_as_the_twin(config: str, space: Space, fill: float, seed: int) -> None:
    field = random_field(CONFIGS[config], space, fill, seed)
    origins, directions = random_rays(65, seed)
    fast = NumbaRenderer(field, threads=2, stop_below=0.0).render_rays(origins, directions)
    slow = TorchRenderer(field).render_rays(origins, directions)
    agree(fast.rgb, slow.rgb, 2e-3)
    agree(fast.opacity, slow.opacity, 2e-3)
    solid = slow.opacity > 0.05
    agree(fast.depth[solid], slow.depth[solid], 5e-3)


@pytest.mark.parametrize("space", [BOX, BALL, PART])
def test_a_view_is_the_twins(space: Space) -> None:
    """Tiles are cut off at the border of this image; in a box only what is met is traced."""
    field = random_field(CONFIGS["wide"], space, 0.3, 5)
    camera, pose = Camera(37, 29, 40.0, 42.0, 17.0, 15.0), look_at((0, -4, 1), (0, 0, 0), (0, 0, 1))
    fast = NumbaRenderer(field, threads=2, stop_below=0.0).render_view(camera, pose)
    slow = TorchRenderer(field).render_view(camera, pose)
    assert fast.rgb.shape == (29, 37, 3)
    agree(fast.rgb / 255.0, slow.rgb / 255.0, 6e-3)
    agree(fast.opacity, slow.opacity, 2e-3)
    solid = slow.opacity > 0.05
    assert solid.mean() > 0.2
    agree(fast.depth[solid], slow.depth[solid], 5e-3)


def agree(a: np.ndarray, b: np.ndarray, tolerance: float) -> None:
    """Equal but for the rare ray with a sample on the border of two cells, which rounding puts in either."""
    assert np.all(np.isfinite(a))
    assert np.all(np.isfinite(b))
    error = np.abs(a - b)
    while error.ndim > 1:
        error = error.max(axis=1)
    assert np.sum(error > tolerance) <= 0.06 * len(a), np.sort(error)[-8:]


@pytest.mark.parametrize("space", [BOX, BALL, PART])
def test_early_stop_costs_no_more_than_its_limit(space: Space) -> None:
    field = random_field(CONFIGS["wide"], space, 0.5, 3)
    origins, directions = random_rays(64, 3)
    full = NumbaRenderer(field, stop_below=0.0).render_rays(origins, directions)
    stopped = NumbaRenderer(field).render_rays(origins, directions)
    assert np.abs(full.opacity - stopped.opacity).max() <= STOP_BELOW + 1e-4


@pytest.mark.parametrize("space", [BOX, BALL, PART])
@pytest.mark.parametrize("name", sorted(CONFIGS))
def test_jacobian_as_the_twin(space: Space, name: str) -> None:
    field = random_field(CONFIGS[name], space, 0.4, 5)
    origins, directions = random_rays(40, 5)
    weights = np.array([[1, 0, 0], [0.3, 0.5, 0.2]], np.float32)
    fast, by_fast = NumbaRenderer(field, threads=2).render_rays_jacobian(origins, directions, weights)
    slow, by_slow = TorchRenderer(field).render_rays_jacobian(origins, directions, weights)
    assert by_fast.shape == (40, 2, 6)
    agree(fast.rgb, slow.rgb, 5e-3)
    agree(by_fast, by_slow, 0.03 * float(np.abs(by_slow).max()))
    assert np.corrcoef(by_fast.ravel(), by_slow.ravel())[0, 1] > 0.98


@pytest.mark.parametrize("space", [BOX, BALL, PART])
@pytest.mark.parametrize("name", sorted(CONFIGS))
def test_training_gradients_as_the_twin(space: Space, name: str) -> None:
    field = random_field(CONFIGS[name], space, 0.4, 7)
    rng = np.random.default_rng(7)
    origins, directions = random_rays(48, 7)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    background, target = rng.random((2, 48, 3), dtype=np.float32)
    jitter = rng.random(48, dtype=np.float32)
    workers = Workers(CONFIGS[name], 1, 32, 8192, backward=True)
    grads = Gradients(*(np.zeros_like(getattr(field.net, n)) for n in Gradients._fields))
    delta, distortion, scale = 0.1, 0.02, 1 / 48
    scratch = workers.scratch[0]
    errors, depths = np.zeros((2, 48), np.float32)
    train(
        field.net, field.domain(), origins, directions, jitter, background, target, 0, 48, 20, 8, 0.0,
        np.float32(delta), np.float32(distortion), np.float32(scale), scratch.samples, scratch.rays, grads,
        errors, depths,
    )  # fmt: skip
    twin = twin_of(field)
    o, d, b = (torch.tensor(a) for a in (origins, directions, background))
    samples = twin.march(o, d, torch.tensor(jitter))
    rays = twin(o, d, b, samples)
    error = rays.rgb - torch.tensor(target)
    loss = torch.nn.functional.huber_loss(rays.rgb, torch.tensor(target), reduction="sum", delta=delta) * scale
    loss = loss + distortion * scale * distortion_loss(samples, rays.weights, space.contracted)
    loss.backward()
    agree(errors, (error.detach() ** 2).sum(dim=1).numpy(), 5e-3)
    half_open = rays.opacity.detach().numpy() > 0.5
    agree(depths[half_open], rays.depth.detach().numpy()[half_open], 5e-3)
    assert not depths[rays.opacity.detach().numpy() < 0.49].any()
    for n in Gradients._fields:
        fast, slow = getattr(grads, n).ravel(), getattr(twin, n).grad.numpy().ravel()
        assert np.linalg.norm(fast - slow) < 0.03 * np.linalg.norm(slow), n


def test_the_packed_domain_keeps_every_occupied_cell() -> None:
    occupied = np.random.default_rng(0).random((16, 16, 16)) < 0.01
    domain = domain_of(BOX, occupied)
    z, y, x = np.nonzero(occupied)
    flat = x + 16 * (y + 16 * z)
    assert np.all(domain.bits[flat >> 3] >> (flat & 7) & 1)
    assert int(np.unpackbits(domain.bits).sum()) == occupied.sum()


def test_block_distances_are_those_to_the_nearest_occupied_block() -> None:
    occupied = np.random.default_rng(0).random((32, 32, 32)) < 5e-5
    distance = domain_of(BOX, occupied).distance.reshape(8, 8, 8)
    blocks = np.argwhere(occupied.reshape(8, 4, 8, 4, 8, 4).any(axis=(1, 3, 5)))
    everywhere = np.stack(np.meshgrid(*[np.arange(8)] * 3, indexing="ij"), axis=-1)
    expected = np.abs(everywhere[..., None, :] - blocks).max(axis=-1).min(axis=-1)
    np.testing.assert_array_equal(distance, expected)
    assert domain_of(BOX, np.zeros((32, 32, 32), bool)).distance.min() == 8
