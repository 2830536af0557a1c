"""The kernel that finds patches, beside a plain twin of it."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldpose.stages.alignment.patches import find_patches


def texture(rng: np.random.Generator, size: tuple[int, int] = (90, 110), blur: float = 1.5) -> np.ndarray:
    values = cv2.GaussianBlur(rng.random(size), (0, 0), blur)
    return ((values - values.min()) / np.ptp(values)).astype(np.float32)


def found(first: np.ndarray, second: np.ndarray, centres: np.ndarray, warps: np.ndarray, starts: np.ndarray,
          half: int = 4, steps: int = 8) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    places, similarity = np.empty((len(centres), 2), np.float32), np.empty(len(centres), np.float32)
    covariance = np.full((len(centres), 2, 2), np.nan, np.float32)
    given_as = [np.ascontiguousarray(array, np.float32) for array in (centres, warps, starts)]
    find_patches(first, second, *given_as, half, steps, places, similarity, covariance)
    return places, similarity, covariance


def bilinear(image: np.ndarray, points: np.ndarray) -> np.ndarray:
    height, width = image.shape
    x, y = np.clip(points[..., 0], 0, width - 1), np.clip(points[..., 1], 0, height - 1)
    column, row = np.minimum(x.astype(int), width - 2), np.minimum(y.astype(int), height - 2)
    u, v = x - column, y - row
    above = (1 - u) * image[row, column] + u * image[row, column + 1]
    below = (1 - u) * image[row + 1, column] + u * image[row + 1, column + 1]
    return (1 - v) * above + v * below


def plain(first: np.ndarray, second: np.ndarray, centre: np.ndarray, warp: np.ndarray, start: np.ndarray,
          half: int, steps: int) -> tuple[np.ndarray, float, np.ndarray]:  # fmt: skip
    """One patch, in float64 and by whole arrays."""
    first, second = first.astype(np.float64), second.astype(np.float64)
    line = np.arange(-half, half + 1)
    grid = np.stack(np.meshgrid(line, line), axis=2)
    weight = np.exp(-(grid**2).sum(axis=2) / (2 * (0.6 * half) ** 2))
    weight /= weight.sum()

    def centred(values: np.ndarray) -> np.ndarray:
        return values - (weight * values).sum()

    patch = centred(bilinear(first, centre + grid @ warp.T))
    across, down = centred(np.gradient(patch, axis=1)), centred(np.gradient(patch, axis=0))
    slopes = np.stack([across, down], axis=2).reshape(-1, 2)
    normal = slopes.T @ (weight.reshape(-1, 1) * slopes)
    if not np.linalg.eigvalsh(normal)[0] > 1e-5:
        return start, -1.0, np.zeros((2, 2))
    contrast, place, alike = np.sqrt((weight * patch**2).sum()), np.array(start, np.float64), -1.0
    for _ in range(steps):
        other = centred(bilinear(second, place + grid))
        there = max(np.sqrt((weight * other**2).sum()), 1e-3)
        alike = float((weight * patch * other).sum() / contrast / there)
        error = weight * (other * contrast / there - patch)
        shift = np.linalg.solve(normal, slopes.T @ error.ravel())
        place -= np.clip(shift, -1, 1)
        if np.linalg.norm(shift) < 0.01:
            break
    if not np.linalg.norm(place - start) < 3:
        return start, -1.0, np.zeros((2, 2))
    left = other * contrast / there - patch
    return place, alike, (weight * left**2).sum() * (weight**2).sum() * np.linalg.inv(normal)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(2, 6), st.integers(1, 6))
def test_the_kernel_does_what_its_plain_twin_does(seed: int, half: int, steps: int) -> None:
    rng = np.random.default_rng(seed)
    first, second = texture(rng), texture(rng)
    second[5:, 3:] = 0.7 * first[:-5, :-3] + 0.3 * second[5:, 3:]
    centres = rng.uniform(-3, 112, (12, 2)).astype(np.float32)
    starts = (centres + np.array([3, 5]) + rng.normal(0, 1, (12, 2))).astype(np.float32)
    warps = (np.eye(2) + rng.normal(0, 0.1, (12, 2, 2))).astype(np.float32)
    places, similarity, covariance = found(first, second, centres, warps, starts, half, steps)
    for i in range(len(centres)):
        place, alike, doubt = plain(first, second, centres[i], warps[i], starts[i], half, steps)
        if abs(np.linalg.norm(place - starts[i]) - 3) > 0.1:  # on the limit either answer is right
            assert places[i] == pytest.approx(place, abs=0.02)
            assert similarity[i] == pytest.approx(alike, abs=0.01)
            if alike > 0.2:  # far below what counts as found; a plain place has no contrast that could be scaled
                assert covariance[i] == pytest.approx(doubt, rel=0.1, abs=0.01 * np.trace(doubt) + 1e-6)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_a_warped_brightened_image_shows_its_patches_where_they_went(seed: int) -> None:
    rng = np.random.default_rng(seed)
    first = texture(rng, (140, 150), 2.0)
    warp = np.eye(2) + rng.uniform(-0.15, 0.15, (2, 2))  # from offsets in the second to offsets in the first
    middle = np.array([75.0, 70.0])
    second = cv2.warpAffine(
        first, np.c_[warp, middle - warp @ middle], (150, 140), flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    )
    truth = middle + rng.uniform(-25, 25, (30, 2))
    centres = middle + (truth - middle) @ warp.T
    starts = truth + rng.uniform(-0.8, 0.8, truth.shape)
    places, similarity, _ = found(first, 0.6 * second + 0.2, centres, np.tile(warp, (30, 1, 1)), starts)
    errors = np.linalg.norm(places - truth, axis=1)
    assert (similarity > 0.95).mean() > 0.9
    assert np.median(errors[similarity > 0.95]) < 0.06


def test_nothing_is_found_where_nothing_is_to_be_seen() -> None:
    even, varied = np.full((60, 60), 0.4, np.float32), texture(np.random.default_rng(0), (60, 60))
    ramp = np.tile(np.linspace(0, 1, 60, dtype=np.float32), (60, 1))
    places = np.array([[30.0, 30.0]], np.float32)
    for first, second in ((even, varied), (ramp, ramp)):
        at, similarity, covariance = found(first, second, places, np.eye(2)[None], places)
        assert not covariance.any()
        assert similarity[0] == -1
        assert np.array_equal(at, places)
    assert found(varied, even, places, np.eye(2)[None], places)[1][0] < 0.1


def test_the_covariance_is_that_of_places_found_in_noise() -> None:
    """Over many draws of noise on the second image alone; a quarter off at most, for what is sampled between pixels."""
    rng = np.random.default_rng(3)
    first = texture(rng, (60, 60), 2.0)
    centre = np.array([[30.0, 29.0]], np.float32)
    draws = [found(first, first + rng.normal(0, 0.01, first.shape).astype(np.float32), centre, np.eye(2)[None], centre)
             for _ in range(400)]  # fmt: skip
    places = np.array([places[0] for places, _, _ in draws])
    covariances = np.array([covariance[0] for _, _, covariance in draws])
    assert np.diag(np.cov(places.T)) == pytest.approx(np.diag(covariances.mean(axis=0)), rel=0.25)


def test_in_the_same_image_no_place_is_less_than_certain() -> None:
    """Rounding may make a correlation larger than 1."""
    rng = np.random.default_rng(5)
    image = texture(rng, (60, 60))
    centres = rng.integers(10, 50, (200, 2)).astype(np.float32)
    _, similarity, covariance = found(image, image, centres, np.tile(np.eye(2), (200, 1, 1)), centres)
    assert similarity.max() > 1 - 1e-6
    assert np.linalg.eigvalsh(covariance.astype(float)).min() > -1e-12


def test_along_an_edge_a_place_is_uncertain() -> None:
    """Of a step that runs down the image with a little texture, across it is told well and down it is not."""
    rng = np.random.default_rng(4)
    edge = np.tile(np.where(np.arange(60) < 30, 0.2, 0.8), (60, 1)) + 0.2 * (texture(rng, (60, 60)) - 0.5)
    first = cv2.GaussianBlur(edge.astype(np.float32), (0, 0), 1)
    noisy = first + rng.normal(0, 0.003, first.shape).astype(np.float32)
    centre = np.array([[30.0, 30.0]], np.float32)
    _, similarity, covariance = found(first, noisy, centre, np.eye(2)[None], centre)
    assert similarity[0] > 0.9
    assert covariance[0, 1, 1] > 10 * covariance[0, 0, 0]
