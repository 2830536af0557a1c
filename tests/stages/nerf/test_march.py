"""Where samples lie along rays, against the plain twin that visits every step."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldpose.stages.nerf.config import FieldConfig
from fieldpose.stages.nerf.field import Field, new_net
from fieldpose.stages.nerf.kernels.march import advance, begin
from fieldpose.stages.nerf.metadata import FieldMetadata, Space
from fieldpose.stages.nerf.twin import twin_of
from fieldpose.stages.nerf.workers import new_rays, new_samples

CONFIG = FieldConfig(levels=2, log2_table=8, finest_resolution=32, occupancy_resolution=32)
SPACES = {
    "box": Space(False, (0, 0, 0), 1.0, half=(1.0, 0.8, 0.9), step=0.02),
    "ball": Space(True, (0, 0, 0), 1.0, near=0.05, far=15.0, step=0.05),
}


def random_field(space: Space, fill: float, seed: int) -> Field:
    """Blobs of occupied cells: far from all of them, near them and within them."""
    rng = np.random.default_rng(seed)
    n = CONFIG.occupancy_resolution
    coarse = rng.random((n // 8, n // 8, n // 8)) < fill
    occupied = np.kron(coarse, np.ones((8, 8, 8), bool)) & (rng.random((n, n, n)) < 0.4)
    return Field(FieldMetadata(space, CONFIG, (0.0, 0.0, 0.0), [], "test", ""), new_net(CONFIG, rng), occupied)


def marched(field: Field, origins: np.ndarray, directions: np.ndarray, per_ray: int) -> list[list[float]]:
    """Distances of each ray's samples, all of them, a few at a time."""
    count = len(origins)
    rays, samples = new_rays(CONFIG, count), new_samples(CONFIG, count * per_ray, backward=False)
    domain, found = field.domain(), [[] for _ in range(count)]
    begin(domain, origins, directions, np.full(count, 0.5, np.float32), 0, count, rays)
    while rays.alive.any():
        rows = advance(domain, count, per_ray, 0, rays, samples)
        for ray, t in zip(samples.ray[:rows], samples.t[:rows], strict=True):
            found[ray].append(float(t))
    return found


@pytest.mark.parametrize("space", sorted(SPACES))
@settings(max_examples=15, deadline=None)
@given(fill=st.sampled_from([0.0, 0.05, 0.5, 1.0]), seed=st.integers(0, 1000), count=st.sampled_from([1, 15, 33]),
       per_ray=st.sampled_from([1, 4, 9]))  # fmt: skip
def test_visits_every_occupied_step(space: str, fill: float, seed: int, count: int, per_ray: int) -> None:
    field = random_field(SPACES[space], fill, seed)
    rng = np.random.default_rng(seed)
    origins = rng.normal(0, 2.0, (count, 3)).astype(np.float32)
    directions = (rng.normal(0, 0.5, (count, 3)) - origins).astype(np.float32)
    directions[0] = (0, 0, -1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    fast = marched(field, origins, directions, per_ray)
    slow = twin_of(field).march(*(torch.tensor(a) for a in (origins, directions)), torch.full((count,), 0.5))
    odd = 0
    for r, found in enumerate(fast):
        assert found == sorted(found)
        expected = slow.t[r][slow.valid[r]].numpy()
        # A step on the border of two cells is put into either by rounding.
        odd += np.sum(np.abs(np.subtract.outer(found, expected)).min(axis=1, initial=np.inf) > 1e-3)
        odd += np.sum(np.abs(np.subtract.outer(expected, found)).min(axis=1, initial=np.inf) > 1e-3)
    assert odd <= 2 + 0.005 * sum(len(found) for found in fast)
