from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from fieldpose.bus.messages import Reason
from fieldpose.errors import ConfigError
from fieldpose.stages.alignment import agreement
from fieldpose.stages.alignment.least_squares import (
    exp_se3_times,
    fit_pose,
    huber_cost,
    huber_delta,
    normal_equations,
    reprojection,
    weighted_lengths,
)
from fieldpose.stages.geometry import Camera, exp_se3, inverse, log_se3, look_at, rotation_error_deg, translation_error
from fieldpose.stages.pnp.core import PnpConfig, PnpResult, solve

Maker = Callable[[np.random.Generator], tuple[np.ndarray, np.ndarray]]
CAMERA = Camera(400, 300, 420.0, 430.0, 201.0, 147.0)
LENS = Camera(400, 300, 420.0, 430.0, 201.0, 147.0, (-0.12, 0.03, 0.001, -0.0015, 0.0))
POSE = look_at((2.5, -2.0, 1.8), (0.0, 0.1, 0.0), (0.0, 0.0, 1.0))


def problem(
    rng: np.random.Generator, count: int = 120, wrong: float = 0.0, noise_px: float = 0.0, camera: Camera = CAMERA
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels, points and which of them belong together."""
    points = rng.uniform(-0.8, 0.8, (count, 3))
    pixels = camera.project(points @ POSE[:3, :3].T + POSE[:3, 3]) + rng.normal(0, noise_px, (count, 2))
    right = np.arange(count) >= wrong * count
    pixels[~right] = rng.uniform(0, (camera.width, camera.height), (int((~right).sum()), 2))
    return pixels.astype(np.float32), points.astype(np.float32), right


def solved(result: PnpResult | Reason) -> PnpResult:
    assert isinstance(result, PnpResult)
    return result


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_exact_correspondences_give_the_pose_through_a_distorting_lens(seed: int) -> None:
    pixels, points, _ = problem(np.random.default_rng(seed), 30, camera=LENS)
    pose = solved(solve(pixels, points, LENS)).cam_from_object
    assert rotation_error_deg(pose, POSE) < 1e-3
    assert translation_error(pose, POSE) < 1e-4


@pytest.mark.parametrize(("count", "wrong"), [(60, 0.5), (300, 0.75), (600, 0.88)])
def test_wrong_matches_are_found_out(count: int, wrong: float) -> None:
    pixels, points, right = problem(np.random.default_rng(3), count, wrong, 0.7)
    result = solved(solve(pixels, points, CAMERA))
    assert rotation_error_deg(solved(result).cam_from_object, POSE) < 0.5
    assert (result.inliers & right).sum() > 0.95 * right.sum()
    assert (result.inliers & ~right).sum() <= max(2, 0.02 * count)
    assert result.residual_px is not None
    assert 0.5 < result.residual_px < 1.5


def test_the_same_input_gives_the_same_result() -> None:
    pixels, points, _ = problem(np.random.default_rng(4), 200, 0.6, 1.0)
    first, second = (solved(solve(pixels, points, CAMERA)) for _ in range(2))
    assert np.array_equal(first.cam_from_object, second.cam_from_object)
    assert np.array_equal(first.inliers, second.inliers)


@pytest.mark.parametrize(("noise_px", "shared"), [(0.3, 0.0), (1.2, 0.0), (0.6, 0.7), (0.6, 1.5)])
def test_the_covariance_is_that_of_the_error(noise_px: float, shared: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """xi^T C^-1 xi is chi-square with 6 degrees of freedom; the mean of 150 lies within 0.6 of 6 by 2 sigma.

    Shared errors count twice, in the residuals and by themselves, but for what the fit takes up: wider limits.
    """
    distances = []
    for seed in range(150):
        rng = np.random.default_rng(seed)
        pixels, points, _ = problem(rng, 80, 0.0, noise_px)
        offsets = shared * noise_px * rng.normal(size=(8, 8, 2))
        column, row = np.clip(pixels // 50, 0, 7).astype(int).T
        pixels = pixels + offsets[row, column].astype(np.float32)
        own = shared / np.hypot(1, shared)  # residuals tell the sum of both errors
        monkeypatch.setattr(agreement, "SHARED_ERROR", own)
        result = solved(solve(pixels, points, CAMERA, PnpConfig(threshold_px=20.0)))
        twist = log_se3(solved(result).cam_from_object @ inverse(POSE))
        assert result.covariance is not None
        distances.append(twist @ np.linalg.solve(result.covariance, twist))
    low, high = (3.0, 8.0) if shared else (5.2, 7.0)
    assert low < np.mean(distances) < high
    if not shared:
        assert stats.kstest(distances, stats.chi2(6).cdf).pvalue > 0.01


def test_a_pose_seen_from_afar_is_less_certain() -> None:
    pixels, points, _ = problem(np.random.default_rng(2), 100, 0.2, 0.5)
    elsewhere = look_at((3, 1, 2), (0, 0, 0), (0, 0, 1))
    near, far = (solved(solve(pixels, points, CAMERA, seen_from=view)) for view in (POSE, elsewhere))
    np.testing.assert_array_equal(near.cam_from_object, far.cam_from_object)
    assert np.linalg.eigvalsh(far.covariance - near.covariance).min() > -1e-15
    assert np.trace(far.covariance) > 1.25 * np.trace(near.covariance)


def test_a_pose_is_none_that_its_inliers_leave_uncertain() -> None:
    pixels, points, _ = problem(np.random.default_rng(3), 60, 0.0, 1.0)
    covariance = solved(solve(pixels, points, CAMERA)).covariance
    distance = float(np.median(np.linalg.norm(points - inverse(POSE)[:3, 3], axis=1)))
    share = np.sqrt(np.trace(covariance[:3, :3])) / distance
    solved(solve(pixels, points, CAMERA, PnpConfig(max_translation_std=1.02 * share)))
    refused = solve(pixels, points, CAMERA, PnpConfig(max_translation_std=0.98 * share))
    assert refused is Reason.IMPLAUSIBLE_POSE


@pytest.mark.parametrize("setting", [{"align_levels": -1}, {"landmarks": -1}, {"iterations": 0}])
def test_settings_that_mean_nothing_are_refused(setting: dict[str, int]) -> None:
    with pytest.raises(ConfigError, match=r"pnp: \w+ is -?\d, but must be at least \d"):
        PnpConfig(**setting)  # type: ignore[arg-type]


@pytest.mark.parametrize("setting", [{"min_inlier_ratio": -0.1}, {"min_inlier_ratio": 30.0}])
def test_shares_that_are_none_are_refused(setting: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=r"pnp: \w+ is -?[\d.]+, but is a share, from 0 to 1"):
        PnpConfig(**setting)  # type: ignore[arg-type]


def test_confidence_tells_precise_matches_from_coarse_ones() -> None:
    errors: dict[str, list[float]] = {"weighted": [], "equal": []}
    for seed in range(20):
        rng = np.random.default_rng(seed)
        pixels, points, _ = problem(rng, 100)
        sigma = np.where(np.arange(100) % 2, 0.1, 1.5)
        pixels = pixels + (rng.normal(size=(100, 2)) * sigma[:, None]).astype(np.float32)
        config = PnpConfig(threshold_px=8.0)
        for name, confidence in (("weighted", 0.1 / sigma), ("equal", None)):
            pose = solved(solve(pixels, points, CAMERA, config, confidence)).cam_from_object
            errors[name].append(translation_error(pose, POSE))
    assert np.mean(errors["weighted"]) < 0.5 * np.mean(errors["equal"])


def test_the_threshold_grows_with_the_image() -> None:
    pixels, points, _ = problem(np.random.default_rng(5), 200, 0.3, 0.8)
    large = CAMERA.resized(4 * CAMERA.width, 4 * CAMERA.height)
    small_result = solved(solve(pixels, points, CAMERA))
    large_result = solved(solve((pixels + 0.5) * 4 - 0.5, points, large))
    assert abs(int(small_result.inliers.sum()) - int(large_result.inliers.sum())) <= 3


def random_pixels(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    return problem(rng, 200, 1.0)[:2]


def too_few(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    return problem(rng, 5)[:2]


def all_in_one_spot(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    pixels, points, _ = problem(rng, 40, 0.0, 0.2)
    near = np.linalg.norm(pixels - pixels[0], axis=1).argsort()[:10]
    points = points[near[0]] + rng.normal(0, 1e-3, (40, 3))
    pixels = CAMERA.project(points @ POSE[:3, :3].T + POSE[:3, 3]) + rng.normal(0, 0.3, (40, 2))
    return pixels.astype(np.float32), points.astype(np.float32)


@pytest.mark.parametrize(
    ("make", "reasons"),
    [
        (random_pixels, {Reason.NO_CONSENSUS, Reason.IMPLAUSIBLE_POSE}),
        (too_few, {Reason.TOO_FEW_CONSISTENT_POINTS}),
        (all_in_one_spot, {Reason.IMPLAUSIBLE_POSE, Reason.NO_CONSENSUS}),
    ],
)
def test_what_holds_no_pose_is_said_to_hold_none(make: Maker, reasons: set[Reason]) -> None:
    pixels, points = make(np.random.default_rng(6))
    assert solve(pixels, points, CAMERA) in reasons


def test_points_behind_the_camera_are_no_inliers() -> None:
    pixels, points, _ = problem(np.random.default_rng(7), 60)
    centre = inverse(POSE)[:3, 3]
    mirrored = np.concatenate([points, 2 * centre - points[:20]]).astype(np.float32)
    result = solved(solve(np.concatenate([pixels, pixels[:20]]), mirrored, CAMERA))
    assert rotation_error_deg(solved(result).cam_from_object, POSE) < 0.01
    assert not result.inliers[60:].any()


def test_the_derivative_is_by_the_left_twist() -> None:
    pixels, points, _ = problem(np.random.default_rng(8), 20)
    _, jacobian = reprojection(pixels, points, CAMERA, POSE)
    for axis, step in enumerate(1e-6 * np.eye(6)):
        ahead, _ = reprojection(pixels, points, CAMERA, exp_se3(step) @ POSE)
        behind, _ = reprojection(pixels, points, CAMERA, exp_se3(-step) @ POSE)
        np.testing.assert_allclose(jacobian[:, :, axis], (ahead - behind) / 2e-6, rtol=1e-4, atol=1e-3)


def random_weights(rng: np.random.Generator, count: int) -> np.ndarray:
    roots = rng.normal(0, 1, (count, 2, 2))
    return roots @ roots.transpose(0, 2, 1) + 0.05 * np.eye(2)


def by_weights(residuals: np.ndarray, weights: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore"):
        lengths = np.sqrt(np.einsum("ni,nij,nj->n", residuals, weights, residuals))
    return np.where(np.isfinite(residuals).all(axis=1), lengths, np.inf)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.1, 50.0))
def test_the_normal_equations_are_those_of_the_plain_residuals(seed: int, delta: float) -> None:
    rng = np.random.default_rng(seed)
    pixels, points, _ = problem(rng, 30, 0.3, 1.0)
    points[:3] = 2 * inverse(POSE)[:3, 3] - points[:3]  # behind the camera
    pixels, points, weights = pixels.astype(np.float64), points.astype(np.float64), random_weights(rng, 30)
    intrinsics = np.array([CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy])
    gradient, hessian, lengths = np.empty(6), np.empty((6, 6)), np.empty(30)
    normal_equations(pixels, points, intrinsics, POSE, weights, delta, gradient, hessian)
    weighted_lengths(pixels, points, intrinsics, POSE, weights, lengths)
    residuals, jacobian = reprojection(pixels, points, CAMERA, POSE)
    plain_lengths = by_weights(residuals, weights)
    np.testing.assert_allclose(lengths, plain_lengths, rtol=1e-9)
    ahead = np.isfinite(plain_lengths)
    assert ahead.sum() == 27
    pull = np.minimum(1, delta / plain_lengths)[ahead, None, None] * weights[ahead] @ jacobian[ahead]
    np.testing.assert_allclose(gradient, np.einsum("nki,nk->i", pull, residuals[ahead]), rtol=1e-9)
    np.testing.assert_allclose(hessian, np.einsum("nki,nkj->ij", pull, jacobian[ahead]), rtol=1e-9, atol=1e-9)


@given(
    st.lists(st.floats(-2.0, 2.0), min_size=3, max_size=3),
    st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3),
    st.floats(1e-7, 3.0),
)
@settings(max_examples=100, deadline=None)
def test_the_compiled_turn_is_the_exponential(shift: list[float], axis: list[float], angle: float) -> None:
    direction = np.array(axis) / max(float(np.linalg.norm(axis)), 1e-6)
    step, out = np.concatenate([shift, angle * direction]), np.empty((4, 4))
    exp_se3_times(step, POSE, out)
    np.testing.assert_allclose(out, exp_se3(step) @ POSE, atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_the_pose_that_is_fitted_is_a_minimum(seed: int) -> None:
    """At it the loss by the plain residuals has no slope, and no neighbour is better."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (60, 3))
    pixels = CAMERA.project(points @ POSE[:3, :3].T + POSE[:3, 3]) + rng.normal(0, 1.5, (60, 2))
    weights = random_weights(rng, 60)
    fit = fit_pose(pixels, points, CAMERA, exp_se3(rng.normal(0, 0.02, 6)) @ POSE, weights, 1e-9)
    delta = huber_delta(by_weights(fit.errors[0], weights))

    def loss(step: np.ndarray) -> float:
        residuals, _ = reprojection(pixels, points, CAMERA, exp_se3(step) @ fit.cam_from_object)
        return huber_cost(by_weights(residuals, weights), delta)

    least = loss(np.zeros(6))
    assert all(loss(sign * 1e-3 * axis) > least for axis in np.eye(6) for sign in (-1, 1))
    slopes = np.array([(loss(1e-6 * axis) - loss(-1e-6 * axis)) / 2e-6 for axis in np.eye(6)])
    curvature = np.array([(loss(1e-3 * axis) + loss(-1e-3 * axis) - 2 * least) / 1e-6 for axis in np.eye(6)])
    assert (np.abs(slopes / curvature) < 1e-5).all()


def test_what_is_exact_in_one_direction_counts_in_that_alone() -> None:
    """Pixels err much along a line of their own and hardly across it; by their weights the pose is far more exact."""
    errors: dict[bool, list[float]] = {False: [], True: []}
    for seed in range(20):
        rng = np.random.default_rng(seed)
        points, angle = rng.uniform(-1, 1, (60, 3)), rng.uniform(0, np.pi, 60)
        along = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        covariances = 4.0 * along[:, :, None] * along[:, None] + 0.01 * np.eye(2)
        noise = np.einsum("nij,nj->ni", np.linalg.cholesky(covariances), rng.normal(size=(60, 2)))
        pixels = CAMERA.project(points @ POSE[:3, :3].T + POSE[:3, 3]) + noise
        for weighted, weights in ((True, np.linalg.inv(covariances)), (False, np.tile(np.eye(2), (60, 1, 1)))):
            fit = fit_pose(pixels, points, CAMERA, POSE, weights, 1e-9)
            errors[weighted].append(rotation_error_deg(fit.cam_from_object, POSE))
    assert np.median(errors[True]) < 0.3 * np.median(errors[False])
