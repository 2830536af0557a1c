"""Covariances with shared errors, against the covariance of every measurement written out."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldpose.stages.geometry import twist_covariance


def ones(count: int) -> np.ndarray:
    return np.tile(np.eye(2), (count, 1, 1))


def written_out(
    jacobian: np.ndarray, weights: np.ndarray, pixels: np.ndarray, side: int, variance: float, shared: float
) -> np.ndarray:
    """(J^T W J)^-1 J^T W S W J (J^T W J)^-1 with the full covariance S of all residuals."""
    n, k = jacobian.shape[:2]
    flat, w, errors = jacobian.reshape(n * k, 6), np.zeros((n * k, n * k)), np.zeros((n * k, n * k))
    for i in range(n):
        own = slice(i * k, (i + 1) * k)
        w[own, own], errors[own, own] = weights[i], variance * np.linalg.inv(weights[i])
        for j in range(n):
            if tuple(pixels[i] // (side / 8)) == tuple(pixels[j] // (side / 8)):
                errors[own, j * k : (j + 1) * k] += np.eye(k) * shared
    gain = np.linalg.inv(flat.T @ w @ flat) @ flat.T @ w
    return gain @ errors @ gain.T


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(8, 40), st.integers(1, 3), st.floats(0, 3))
def test_it_is_the_covariance_of_the_weighted_fit(seed: int, count: int, k: int, shared: float) -> None:
    rng = np.random.default_rng(seed)
    jacobian, roots = rng.normal(size=(count, k, 6)), rng.normal(size=(count, k, k))
    weights = roots @ roots.transpose(0, 2, 1) + 0.2 * np.eye(k)
    pixels = rng.uniform(0, 400, (count, 2))
    arguments = (jacobian, weights, pixels, 400, 0.7, shared)
    expected = written_out(*arguments)
    np.testing.assert_allclose(twist_covariance(*arguments), expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max())


def test_more_of_the_same_cell_tells_no_more_than_the_cell() -> None:
    rng = np.random.default_rng(0)
    few, places = rng.normal(size=(30, 2, 6)), rng.uniform(0, 400, (30, 2))
    many, more_places = np.repeat(few, 200, axis=0), np.repeat(places, 200, axis=0)
    sparse = twist_covariance(few, ones(30), places, 400, 1.0, 1.0)
    dense = twist_covariance(many, ones(6000), more_places, 400, 1.0, 1.0)
    alone = twist_covariance(many, ones(6000), more_places, 400, 1.0, 0.0)
    assert np.trace(alone) == pytest.approx(np.trace(twist_covariance(few, ones(30), places, 400, 1.0, 0.0)) / 200)
    assert 0.3 * np.trace(sparse) < np.trace(dense) < np.trace(sparse)


def test_what_has_no_weight_tells_nothing() -> None:
    rng = np.random.default_rng(1)
    jacobian, weights, pixels = rng.normal(size=(40, 2, 6)), ones(40), rng.uniform(0, 400, (40, 2))
    padded = np.concatenate([jacobian, rng.normal(size=(400, 2, 6))]), np.concatenate([weights, np.zeros((400, 2, 2))])
    places = np.concatenate([pixels, rng.uniform(0, 400, (400, 2))])
    alone = twist_covariance(jacobian, weights, pixels, 400, 1.0, 0.7)
    np.testing.assert_allclose(twist_covariance(*padded, places, 400, 1.0, 0.7), alone, rtol=1e-9)


def test_what_nothing_determines_is_uncertain() -> None:
    rng = np.random.default_rng(2)
    jacobian = rng.normal(size=(40, 2, 6))
    jacobian[..., 2] = 0
    covariance = twist_covariance(jacobian, ones(40), rng.uniform(0, 400, (40, 2)), 400, 1.0, 0.7)
    assert covariance[2, 2] > 1e8
    assert np.diag(covariance)[[0, 1, 3, 4, 5]].max() < 1
