"""The vector forms of the kernels' inner loops against numpy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from fieldpose.stages.nerf.config import FieldConfig
from fieldpose.stages.nerf.field import new_net
from fieldpose.stages.nerf.kernels.encoding import encode, position_gradients, scatter
from fieldpose.stages.nerf.kernels.layers import layer
from fieldpose.stages.nerf.kernels.packet import density, exponential, log_up_to_two
from fieldpose.stages.nerf.kernels.vectors import reads_half_floats
from fieldpose.stages.nerf.metadata import Space
from fieldpose.stages.nerf.twin import TwinField
from fieldpose.stages.nerf.workers import new_samples


@njit
def _logarithms(x: np.ndarray, out: np.ndarray) -> None:
    for i in range(x.shape[0]):
        out[i] = log_up_to_two(x[i])


@njit
def _exponentials(x: np.ndarray, out: np.ndarray, what: int) -> None:
    for i in range(x.shape[0]):
        out[i] = exponential(x[i]) if what == 0 else density(x[i])


def test_the_exponential_is_as_exact_as_single_precision() -> None:
    x = np.linspace(-87, 88, 200_001, dtype=np.float32)
    out = np.empty_like(x)
    _exponentials(x, out, 0)
    np.testing.assert_allclose(out, np.exp(x.astype(np.float64)), rtol=3e-7)


def test_the_logarithm_up_to_two() -> None:
    x = np.linspace(1, 2, 10_001, dtype=np.float32)
    out = np.empty_like(x)
    _logarithms(x, out)
    np.testing.assert_allclose(out, np.log(x.astype(np.float64)), atol=2e-6)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10_000), inputs=st.integers(1, 40), outputs=st.sampled_from([1, 3, 16, 24, 32, 47]),
    first=st.integers(0, 20), count=st.integers(0, 70), floor=st.sampled_from([0.0, -np.inf]),
)  # fmt: skip
def test_layers_are_products(seed: int, inputs: int, outputs: int, first: int, count: int, floor: float) -> None:
    """Rows outside the range stay as they are, and a row is the same bits whatever rows are computed with it."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(first + count + 2, inputs)).astype(np.float32)
    w = rng.normal(size=(inputs, outputs)).astype(np.float32)
    out, alone = np.full((2, len(x), outputs), 7, np.float32)
    layer(x, w, np.float32(floor), first, first + count, out)
    rows = slice(first, first + count)
    np.testing.assert_allclose(out[rows], np.maximum(x[rows].astype(np.float64) @ w, floor), atol=1e-4)
    assert np.all(out[:first] == 7)
    assert np.all(out[first + count :] == 7)
    for row in range(first, first + count):
        layer(x, w, np.float32(floor), row, row + 1, alone)
    np.testing.assert_array_equal(out, alone)


def test_a_layer_hides_no_nan() -> None:
    out = np.zeros((20, 16), np.float32)
    layer(np.full((20, 3), np.nan, np.float32), np.ones((3, 16), np.float32), np.float32(0), 0, 20, out)
    assert np.all(np.isnan(out))


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(1, 200), width=st.sampled_from([2, 4]))
def test_encodes_as_the_twin(seed: int, count: int, width: int) -> None:
    """On the borders of the cube as well, in dense levels and in hashed ones."""
    config = FieldConfig(levels=4, level_features=width, log2_table=10, base_resolution=4, finest_resolution=90)
    rng = np.random.default_rng(seed)
    net = new_net(config, rng)
    net.table[:] = rng.normal(size=net.table.shape)
    samples = new_samples(config, count, backward=False)
    samples.u[:, :count] = np.clip(rng.uniform(-0.1, 1.1, (3, count)), 0, 1)
    encode(net, samples, 0, count)
    n = config.occupancy_resolution
    twin = TwinField(net, Space(False, (0, 0, 0), 1.0), np.ones((n, n, n), bool))
    expected = twin.encode(torch.tensor(samples.u[:, :count].T)).detach().numpy()
    np.testing.assert_allclose(samples.x, expected, atol=2e-3)


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
