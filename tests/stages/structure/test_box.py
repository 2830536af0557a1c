"""The box around what stands apart where cameras look."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldpose.stages.geometry import look_at
from fieldpose.stages.structure.box import object_box

LOW, HIGH = np.array([-0.2, -0.1, 0.0]), np.array([0.15, 0.2, 0.5])


def cameras(height: float = 0.7) -> np.ndarray:
    turns = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    eyes = np.stack([1.5 * np.cos(turns), 1.5 * np.sin(turns), np.full(16, height)], axis=1)
    return np.stack([look_at(eye, (LOW + HIGH) / 2, (0, 0, 1)) for eye in eyes])


def surface(rng: np.random.Generator, count: int, low: np.ndarray = LOW, high: np.ndarray = HIGH) -> np.ndarray:
    """Points on the faces of a box."""
    points = rng.uniform(low, high, (count, 3))
    axis, end = rng.integers(0, 3, count), rng.integers(0, 2, count)
    points[np.arange(count), axis] = np.where(end == 1, high[axis], low[axis])
    return points


def floor(rng: np.random.Generator, count: int) -> np.ndarray:
    return np.concatenate([rng.uniform(-3, 3, (count, 2)), rng.normal(0, 0.003, (count, 1))], axis=1)


def scene(seed: int, on_floor: bool) -> np.ndarray:
    """The thing, another one beside it and points astray; with the floor that both stand on, or without."""
    rng = np.random.default_rng(seed)
    other = surface(rng, 400, np.array([0.55, 0.5, 0.0]), np.array([0.75, 0.7, 0.3]))
    parts = [surface(rng, 1500), other, rng.uniform((-1, -1, 0.1), (1, 1, 1), (60, 3))]
    return np.concatenate([*parts, floor(rng, 3000)] if on_floor else parts)


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 10_000), st.booleans())
def test_the_box_is_that_of_the_thing_looked_at(seed: int, on_floor: bool) -> None:
    box = object_box(scene(seed, on_floor), cameras())
    assert box is not None
    np.testing.assert_allclose(box[0, :2], LOW[:2], atol=0.06)
    np.testing.assert_allclose(box[1], HIGH, atol=0.06)
    assert box[0, 2] == pytest.approx(0.0, abs=0.01 if on_floor else 0.06)
    assert (box[0, :2] < LOW[:2]).all()
    assert (box[1] > HIGH).all()


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_the_unit_does_not_matter(scale: float) -> None:
    points, poses = scene(3, True), cameras()
    larger = poses.copy()
    larger[:, :3, 3] *= scale
    np.testing.assert_allclose(object_box(points * scale, larger), object_box(points, poses) * scale, rtol=1e-6)


def test_where_nothing_stands_apart_there_is_none() -> None:
    rng = np.random.default_rng(0)
    assert object_box(floor(rng, 3000), cameras()) is None
    assert object_box(rng.uniform(-2, 2, (20000, 3)), cameras()) is None
    assert object_box(np.empty((0, 3)), cameras()) is None
