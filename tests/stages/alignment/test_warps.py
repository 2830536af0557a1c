"""The kernel that tells how patches of a view are warped in a frame, beside a plain twin of it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.analytic_scene import camera

from fieldpose.stages.alignment.least_squares import intrinsics_of
from fieldpose.stages.alignment.warps import warp_patches
from fieldpose.stages.geometry import Camera, exp_se3

VIEW = camera(200)


def warped(
    pixels: np.ndarray, inverse_depth: np.ndarray, slopes: np.ndarray, frame_from_view: np.ndarray, lens: Camera
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    count = len(pixels)
    places, warps, seen = np.zeros((count, 2), np.float32), np.zeros((count, 2, 2), np.float32), np.zeros(count, bool)
    warp_patches(
        pixels, inverse_depth, slopes, intrinsics_of(VIEW), frame_from_view, intrinsics_of(lens),
        np.array(lens.distortion), (lens.width, lens.height), places, warps, seen,
    )  # fmt: skip
    return places, warps, seen


def plain(
    pixel: np.ndarray, inverse_depth: float, slope: np.ndarray, frame_from_view: np.ndarray, lens: Camera
) -> tuple[np.ndarray, np.ndarray, bool]:
    """One point, by whole arrays: the plane through it is put into the frame's camera and projected."""
    offsets = np.array([[0.0, 0.0], [-0.5, 0.0], [0.5, 0.0], [0.0, -0.5], [0.0, 0.5]])
    rays = np.c_[(pixel + offsets - (VIEW.cx, VIEW.cy)) / (VIEW.fx, VIEW.fy), np.ones(5)]
    in_frame = rays @ frame_from_view[:3, :3].T + (inverse_depth + offsets @ slope)[:, None] * frame_from_view[:3, 3]
    if not (in_frame[:, 2] > 1e-6).all():
        return np.zeros(2), np.zeros((2, 2)), False
    at, left, right, above, below = lens.project(in_frame)
    warp = np.stack([right - left, below - above], axis=1)
    inside = bool(np.all((at >= 0) & (at <= (lens.width - 1, lens.height - 1))))
    return at, warp, inside and 0.15 < np.linalg.det(warp) < 6.0


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.booleans(), st.floats(0.0, 1.5))
def test_the_kernel_does_what_its_plain_twin_does(seed: int, distorted: bool, motion: float) -> None:
    rng = np.random.default_rng(seed)
    lens = camera(260, (-0.1, 0.02, 0.001, -0.001, 0.01) if distorted else (0.0,) * 5)
    pixels, inverse_depth = rng.uniform(-2, 201, (40, 2)), rng.uniform(0.1, 0.6, 40)
    inverse_depth[0], slopes = np.nan, rng.normal(0, 2e-3, (40, 2))
    frame_from_view = exp_se3(rng.normal(0, motion, 6) * (1, 1, 1, 0.4, 0.4, 0.4))
    places, warps, seen = warped(pixels, inverse_depth, slopes, frame_from_view, lens)
    assert not seen[0]
    for i in range(1, len(pixels)):
        at, warp, visible = plain(pixels[i], inverse_depth[i], slopes[i], frame_from_view, lens)
        assert seen[i] == visible
        if visible:
            assert places[i] == pytest.approx(at, abs=1e-4)
            np.testing.assert_allclose(warps[i] @ warp, np.eye(2), atol=1e-4)


def test_without_motion_a_view_is_seen_as_it_is() -> None:
    pixels = np.random.default_rng(0).uniform(0, 199, (30, 2))
    places, warps, seen = warped(pixels, np.full(30, 0.3), np.zeros((30, 2)), np.eye(4), VIEW)
    assert seen.all()
    np.testing.assert_allclose(places, pixels, atol=1e-4)
    np.testing.assert_allclose(warps, np.tile(np.eye(2), (30, 1, 1)), atol=1e-5)
