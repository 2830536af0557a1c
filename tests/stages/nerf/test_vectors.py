"""The vector forms of the kernels' inner loops against numpy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from fieldpose.stages.nerf.config import FieldConfig
from fieldpose.stages.nerf.field import new_net
from fieldpose.stages.nerf.kernels.encoding import encode, position_gradients, scatter
from fieldpose.stages.nerf.kernels.packet import density, exponential
from fieldpose.stages.nerf.kernels.vectors import reads_half_floats
from fieldpose.stages.nerf.workers import new_samples


@njit
def _exponentials(x: np.ndarray, out: np.ndarray, what: int) -> None:
    for i in range(x.shape[0]):
        out[i] = exponential(x[i]) if what == 0 else density(x[i])


def test_the_exponential_is_as_exact_as_single_precision() -> None:
    x = np.linspace(-87, 88, 200_001, dtype=np.float32)
    out = np.empty_like(x)
    _exponentials(x, out, 0)
    np.testing.assert_allclose(out, np.exp(x.astype(np.float64)), rtol=3e-7)


def test_densities_are_finite_whatever_the_network_says() -> None:
    x = np.array([-np.inf, -1e30, -80, 0, 11, 1e30, np.inf], np.float32)
    out = np.empty_like(x)
    _exponentials(x, out, 1)
    assert np.all(np.isfinite(out))
    assert out[3] == pytest.approx(1)
    assert out[-1] == pytest.approx(np.exp(11), rel=1e-6)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(1, 200), first=st.integers(0, 70), width=st.sampled_from([2, 4]))
def test_scatter_is_the_transpose_of_encode(seed: int, count: int, first: int, width: int) -> None:
    """<encode(table), g> = <table, scatter(g)> for every table and g, and rows outside the range stay as they are."""
    config = FieldConfig(levels=3, level_features=width, log2_table=8, base_resolution=4, finest_resolution=40)
    rng = np.random.default_rng(seed)
    net = new_net(config, rng)
    net.table[:] = rng.normal(size=net.table.shape)
    samples = new_samples(config, first + count + 3, backward=True)
    samples.u[:, : first + count] = rng.random((3, first + count))
    samples.x[:] = 7
    samples.dx[:] = rng.normal(size=samples.dx.shape)
    encode(net, samples, first, first + count)
    assert np.all(samples.x[:first] == 7)
    assert np.all(samples.x[first + count :] == 7)
    dtable = np.zeros_like(net.table)
    scatter(net, samples, first, first + count, dtable)
    rows = slice(first, first + count)
    left = float((samples.x[rows].astype(np.float64) * samples.dx[rows]).sum())
    right = float((net.table.astype(np.float64) * dtable).sum())
    assert left == pytest.approx(right, rel=1e-4, abs=1e-3)


@pytest.mark.skipif(not reads_half_floats(), reason="this processor does not read float16")
def test_half_precision_tables_are_read_as_what_they_hold() -> None:
    config = FieldConfig(levels=4, log2_table=9, finest_resolution=64)
    rng = np.random.default_rng(3)
    net = new_net(config, rng)
    half = rng.normal(size=net.table.shape).astype(np.float16)
    samples = new_samples(config, 100, backward=True)
    samples.u[:, :100] = rng.random((3, 100))
    samples.dx[:] = rng.normal(size=samples.dx.shape)
    results = []
    for table in (half.astype(np.float32), half.view(np.uint16)):
        encode(net._replace(table=table), samples, 0, 100)
        du = np.empty((3, 100), np.float32)
        position_gradients(net._replace(table=table), samples, 0, 100, du)
        results.append((samples.x.copy(), du))
    for single, packed in zip(*results, strict=True):
        np.testing.assert_allclose(packed, single, rtol=1e-5, atol=1e-4)
