"""Looking for lifted points in the frame, on a scene whose geometry is known exactly."""

import cv2
import msgspec
import numpy as np
import pytest
from support.analytic_scene import AnalyticScene, camera, viewpoint

from fieldpose.bus.messages import Reason
from fieldpose.errors import GeometryError
from fieldpose.stages.alignment import constants as alignment_constants
from fieldpose.stages.alignment.placing import Placed
from fieldpose.stages.alignment.views import inverse_depth_slopes
from fieldpose.stages.geometry import Camera, exp_se3, perturb, rays, rotation_error_deg, translation_error
from fieldpose.stages.nerf.rendering_api import RenderedView
from fieldpose.stages.pnp import constants
from fieldpose.stages.pnp.aligner import Aligner, Pictures
from fieldpose.stages.pnp.core import PnpConfig, PnpResult, solve

TRUTH = viewpoint(25.0, 38.0)
LENS = camera(260, (-0.1, 0.02, 0.001, -0.001, 0.0))
VIEW = camera(200)


def photograph(scene: AnalyticScene, lens: Camera, pose: np.ndarray = TRUTH) -> np.ndarray:
    rgb = scene.render_rays(*rays(lens, pose)).rgb.reshape(lens.height, lens.width, 3)
    return np.rint(np.clip(rgb, 0, 1) * 255).astype(np.uint8)


@pytest.fixture(scope="module")
def scene() -> AnalyticScene:
    return AnalyticScene()


@pytest.fixture(scope="module")
def view(scene: AnalyticScene) -> RenderedView:
    return scene.render_view(VIEW, perturb(TRUTH, np.random.default_rng(4), (12.0, 12.0), 0.1))


@pytest.fixture(scope="module")
def frame(scene: AnalyticScene) -> np.ndarray:
    return photograph(scene, LENS)


@pytest.fixture(scope="module")
def points(view: RenderedView) -> np.ndarray:
    """Points of the surface, away from silhouettes."""
    rng, opaque = np.random.default_rng(0), view.opacity > 0.99
    y, x = np.nonzero(opaque & (np.abs(np.gradient(view.depth)).max(axis=0) < 0.05))
    chosen = rng.choice(len(x), 250, replace=False)
    origins, directions = rays(view.camera, view.cam_from_object, np.stack([x, y], axis=1)[chosen])
    return origins + view.depth[y, x][chosen, None] * directions


def pictures(view: RenderedView, frame: np.ndarray) -> Pictures:
    return Pictures(view.rgb, view.depth, view.camera, view.cam_from_object, frame)


def unplain(frame: np.ndarray) -> np.ndarray:
    """The frame with a border of noise, so that no plain background contradicts anything."""
    noisy = np.random.default_rng(0).integers(0, 256, frame.shape).astype(np.uint8)
    noisy[3:-3, 3:-3] = frame[3:-3, 3:-3]
    return noisy


def in_frame(points: np.ndarray, lens: Camera = LENS) -> np.ndarray:
    return lens.project(points @ TRUTH[:3, :3].T + TRUTH[:3, 3])


def matched(points: np.ndarray, wrong: float, noise_px: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    pixels = in_frame(points) + rng.normal(0, noise_px, (len(points), 2))
    count = int(wrong * len(points))
    pixels[:count] = rng.uniform(0, 259, (count, 2))
    return pixels.astype(np.float32)


def solved(result: PnpResult | Reason) -> PnpResult:
    assert isinstance(result, PnpResult)
    return result


def pose_of(result: PnpResult | Reason) -> np.ndarray:
    return solved(result).cam_from_object


def test_points_are_found_where_they_are(view: RenderedView, frame: np.ndarray, points: np.ndarray) -> None:
    aligner = Aligner(pictures(view, frame), points, LENS, PnpConfig())
    placed = aligner.place(exp_se3([0.01, -0.005, 0.01, 0.002, -0.003, 0.002]) @ TRUTH, 0)
    errors = np.linalg.norm(placed.pixels - in_frame(points)[placed.index], axis=1)
    assert len(placed.index) > 100
    assert np.median(errors) < 0.25


def test_coarse_patches_reach_farther(view: RenderedView, frame: np.ndarray, points: np.ndarray) -> None:
    """The same patch in an image four times as coarse is looked for four times as far away."""
    aligner, astray = Aligner(pictures(view, frame), points, LENS, PnpConfig()), exp_se3([0.08, 0, 0, 0, 0, 0]) @ TRUTH
    near = []
    for level in (0, 2):
        placed = aligner.place(astray, level)
        near.append((np.linalg.norm(placed.pixels - in_frame(points)[placed.index], axis=1) < 2).sum())
    assert near[1] > 2 * near[0]
    assert near[1] > 60


def test_the_pose_is_better_by_pictures_than_by_matches(
    view: RenderedView, frame: np.ndarray, points: np.ndarray
) -> None:
    pixels = matched(points, 0.6, 1.5)
    plain = solved(solve(pixels, points, LENS))
    better = solved(solve(pixels, points, LENS, pictures=pictures(view, frame)))
    assert rotation_error_deg(pose_of(better), TRUTH) < 0.4 * rotation_error_deg(pose_of(plain), TRUTH)
    assert translation_error(pose_of(better), TRUTH) < 0.4 * translation_error(pose_of(plain), TRUTH)
    assert better.inliers.sum() > plain.inliers.sum()
    found = better.inliers_in_frame[: better.inliers.sum()]
    assert np.median(np.linalg.norm(found - in_frame(points)[better.inliers], axis=1)) < 0.3


def test_a_wrong_pose_is_told_by_how_little_is_found(
    scene: AnalyticScene, view: RenderedView, points: np.ndarray
) -> None:
    """Matches that agree on a pose from which the frame was not taken."""
    elsewhere = photograph(scene, LENS, viewpoint(200.0, 15.0))
    pixels = matched(points, 0.0, 1.0)
    agreed = solved(solve(pixels, points, LENS, PnpConfig(align_levels=0), pictures=pictures(view, elsewhere)))
    assert agreed.inliers.mean() > 0.8
    placed = Aligner(pictures(view, elsewhere), points, LENS, PnpConfig()).place(pose_of(agreed), 0)
    assert len(placed.index) < constants.MIN_SUPPORT * len(points)


def test_few_matches_give_a_pose_only_if_points_are_found_where_it_puts_them(
    scene: AnalyticScene,
    view: RenderedView,
    frame: np.ndarray,
    points: np.ndarray,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One in seventeen matches is right, which is too few to believe without seeing."""
    monkeypatch.setattr(constants, "LEAST_ITERATIONS", 50_000)
    pixels, config = matched(points, 0.94, 0.4, seed=3), PnpConfig(iterations=50_000)
    assert isinstance(solve(pixels, points, LENS, config), Reason)
    seen = solved(solve(pixels, points, LENS, config, pictures=pictures(view, frame)))
    assert rotation_error_deg(pose_of(seen), TRUTH) < 0.3
    elsewhere = photograph(scene, LENS, viewpoint(200.0, 15.0))
    assert isinstance(solve(pixels, points, LENS, config, pictures=pictures(view, elsewhere)), Reason)


@pytest.mark.parametrize("size", [(1, 200), (200, 1), (1, 1)])
def test_a_picture_one_pixel_wide_shows_nothing(points: np.ndarray, size: tuple[int, int]) -> None:
    thin = Camera(*size, 270.0, 270.0, (size[0] - 1) / 2, (size[1] - 1) / 2)
    blank = np.zeros((size[1], size[0], 3), np.uint8)
    given = Pictures(blank, np.ones(blank.shape[:2], np.float32), thin, TRUTH, blank)
    assert len(Aligner(given, points, thin, PnpConfig()).place(TRUTH, 0).index) == 0


def test_another_pose_is_asked_for_where_matches_agree_on_a_wrong_one(
    view: RenderedView, frame: np.ndarray, points: np.ndarray
) -> None:
    """Most matches agree, as those of a repeated pattern do, on a pose at which the frame shows nothing of them."""
    pixels, wrong = matched(points, 0.0, 0.5), viewpoint(75.0, 20.0)
    elsewhere = LENS.project(points @ wrong[:3, :3].T + wrong[:3, 3])
    pixels[:150] = elsewhere[:150]
    assert rotation_error_deg(pose_of(solve(pixels, points, LENS)), wrong) < 2
    assert rotation_error_deg(pose_of(solve(pixels, points, LENS, pictures=pictures(view, frame))), TRUTH) < 0.3


@pytest.mark.parametrize("seed", range(3))
def test_landmarks_hold_a_pose_that_is_matched_in_one_place_only(
    view: RenderedView, frame: np.ndarray, points: np.ndarray, seed: int
) -> None:
    close = np.argsort(np.linalg.norm(points - points[seed], axis=1))[:25]
    pixels = matched(points, 0.0, 0.5, seed)[close]
    without = solved(solve(pixels, points[close], LENS, PnpConfig(landmarks=0), pictures=pictures(view, frame)))
    result = solved(solve(pixels, points[close], LENS, pictures=pictures(view, frame)))
    assert translation_error(pose_of(result), TRUTH) < 0.6 * translation_error(pose_of(without), TRUTH)
    assert result.inliers.shape == (25,)
    assert len(without.inliers_in_frame) <= without.correspondences == 25
    assert 25 < len(result.inliers_in_frame) < result.correspondences <= 125


def test_parts_that_look_alike_are_told_apart_by_landmarks(
    view: RenderedView,
    frame: np.ndarray,
    points: np.ndarray,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The box's top is there twice, and more matches agree on the wrong one, where their patches are found."""
    wrong = exp_se3([0.35, 0.1, 0, 0, 0, 0]) @ TRUTH
    here, there = in_frame(points), LENS.project(points @ wrong[:3, :3].T + wrong[:3, 3])
    top, right = np.argsort(here[:, 1])[:60], np.argsort(here[:, 1])[-45:]
    doubled = frame.copy()
    for x, y, u, v in np.rint(np.hstack([here, there])).astype(int)[top]:
        doubled[v - 9 : v + 10, u - 9 : u + 10] = frame[y - 9 : y + 10, x - 9 : x + 10]
    pixels = np.random.default_rng(1).uniform(0, 259, here.shape).astype(np.float32)
    pixels[top], pixels[right] = there[top], here[right]
    given = pictures(view, unplain(doubled))
    with monkeypatch.context() as patched:
        patched.setattr(constants, "SURE_LANDMARKS", 0.0)
        hasty = solved(solve(pixels, points, LENS, pictures=given))
    assert rotation_error_deg(pose_of(hasty), wrong) < 1
    assert translation_error(pose_of(hasty), wrong) < 0.05
    assert translation_error(pose_of(solve(pixels, points, LENS, pictures=given)), TRUTH) < 0.01


def test_a_pose_that_the_plain_background_contradicts_leaves_its_place_to_the_next(
    view: RenderedView, frame: np.ndarray, points: np.ndarray
) -> None:
    """Most matches agree on a pose that would have a part of the object where nothing is; others on the right one."""
    wrong = exp_se3([0.35, 0.1, 0, 0, 0, 0]) @ TRUTH
    here, there = in_frame(points), LENS.project(points @ wrong[:3, :3].T + wrong[:3, 3])
    pixels = there.astype(np.float32)
    pixels[::3] = here[::3]
    assert translation_error(pose_of(solve(pixels, points, LENS)), wrong) < 0.01
    assert translation_error(pose_of(solve(pixels, points, LENS, pictures=pictures(view, frame))), TRUTH) < 0.01
    only_wrong = solve(there.astype(np.float32), points, LENS, pictures=pictures(view, frame))
    assert only_wrong is Reason.NO_CONSENSUS


def test_no_pose_is_borne_out_where_too_few_landmarks_are_found(
    view: RenderedView,
    frame: np.ndarray,
    points: np.ndarray,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """All of the frame but the box's top is covered, and few matches are right: those there."""
    here = in_frame(points)
    top = np.argsort(here[:, 1])[:60]
    covered = frame.copy()
    covered[int(here[top, 1].max()) + 9 :] = 128
    pixels = np.random.default_rng(2).uniform(0, 259, here.shape).astype(np.float32)
    pixels[top] = here[top]
    given = pictures(view, covered)
    assert translation_error(pose_of(solve(pixels, points, LENS, pictures=given)), TRUTH) < 0.01
    monkeypatch.setattr(constants, "MIN_LANDMARKS", 0.6)
    assert isinstance(solve(pixels, points, LENS, pictures=given), Reason)


@pytest.mark.parametrize("frame_shade", [0, 255])
def test_a_frame_without_anything_leaves_the_pose_of_the_matches(
    view: RenderedView, points: np.ndarray, frame_shade: int
) -> None:
    blank, pixels = unplain(np.full((260, 260, 3), frame_shade, np.uint8)), matched(points, 0.3, 1.0)
    plain = solved(solve(pixels, points, LENS))
    looked = solved(solve(pixels, points, LENS, pictures=pictures(view, blank)))
    assert np.array_equal(pose_of(looked), pose_of(plain))
    assert np.array_equal(looked.inliers, plain.inliers)


def test_few_matches_that_no_search_bears_out_are_not_believed(
    view: RenderedView, points: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fifth of the matches agrees, which is enough by itself, but nothing of the view is seen in the frame."""
    blank, pixels = unplain(np.full((260, 260, 3), 128, np.uint8)), matched(points, 0.8, 0.5)
    solved(solve(pixels, points, LENS))
    given = pictures(view, blank)
    assert solve(pixels, points, LENS, pictures=given) is Reason.NO_CONSENSUS
    monkeypatch.setattr(constants, "MIN_UNALIGNED", 0.1)
    solved(solve(pixels, points, LENS, pictures=given))


@pytest.mark.parametrize(("radius_px", "believed"), [(0.9, True), (2.2, False)])
def test_points_that_lie_anywhere_where_they_were_looked_for_were_found_by_chance(
    view: RenderedView, frame: np.ndarray, points: np.ndarray, monkeypatch: pytest.MonkeyPatch, radius_px: float,
    believed: bool,
) -> None:  # fmt: skip
    """Looked for within 1.95 pixels of the frame; where they fill that, the pose is that of the matches after all."""
    rng, count = np.random.default_rng(1), len(points)
    angle, radius = rng.uniform(0, 2 * np.pi, count), radius_px * np.sqrt(rng.random(count))
    scattered = in_frame(points) + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    placed = Placed(np.arange(count), scattered, np.tile(np.eye(2), (count, 1, 1)), np.ones(count, bool))
    monkeypatch.setattr(Aligner, "place", lambda self, pose, level, most=None: placed)
    pixels = matched(points, 0.3, 0.5)
    plain = solved(solve(pixels, points, LENS))
    looked = solved(solve(pixels, points, LENS, PnpConfig(landmarks=0), pictures=pictures(view, frame)))
    assert np.array_equal(pose_of(looked), pose_of(plain)) is not believed


def test_a_blurred_frame_is_better_known_by_its_matches(
    view: RenderedView, frame: np.ndarray, points: np.ndarray
) -> None:
    """Patches are hardly found in it; the pose must not come to rest on the few that are."""
    shaken, pixels = cv2.GaussianBlur(frame, (0, 0), 9.0), matched(points, 0.2, 0.7)
    pixels[200:] += np.array([3.5, 2.5], np.float32)  # near misses agree among themselves too
    result = solved(solve(pixels, points, LENS, pictures=pictures(view, shaken)))
    assert result.inliers.sum() > 120
    assert rotation_error_deg(pose_of(result), TRUTH) < 0.5


def test_nothing_is_found_beyond_the_frame(
    view: RenderedView, frame: np.ndarray, points: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A camera turned so that many points are at its image's border."""
    monkeypatch.setattr(alignment_constants, "SIMILARITY", -1.0)
    aligner = Aligner(pictures(view, frame), points, LENS, PnpConfig())
    for angle in (0.2, 0.25, 0.3):
        placed = aligner.place(exp_se3([0, 0, 0, 0, angle, 0]) @ TRUTH, 2)
        assert len(placed.index) > 10
        assert np.all((placed.pixels >= -0.5) & (placed.pixels <= 259.5))


def test_landmarks_outside_the_frame_are_not_missed(view: RenderedView, frame: np.ndarray, points: np.ndarray) -> None:
    """The frame is the left part of the camera's image."""
    here = in_frame(points)
    left = here[:, 0] < 118
    narrow = msgspec.structs.replace(LENS, width=120)
    cut = solved(solve(here[left].astype(np.float32), points[left], narrow, pictures=pictures(view, frame[:, :120])))
    assert translation_error(pose_of(cut), TRUTH) < 0.01
    assert len(points[left]) + 33 <= cut.correspondences < len(points[left]) + 70


def test_a_pose_that_landmarks_do_not_bear_out_says_how_many_points_were_looked_for(
    scene: AnalyticScene, view: RenderedView, points: np.ndarray
) -> None:
    """So that it does not pass for one that all points agree on."""
    elsewhere = unplain(photograph(scene, LENS, viewpoint(200.0, 15.0)))
    believed = solved(solve(matched(points, 0.0, 1.0), points, LENS, pictures=pictures(view, elsewhere)))
    assert believed.correspondences == len(points) + 100


def test_points_found_where_the_lens_has_no_inverse_leave_the_pose_of_the_matches(
    view: RenderedView, frame: np.ndarray, points: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """k1 = -1.2 folds the image over itself 123 pixels from its middle."""
    folding = msgspec.structs.replace(LENS, distortion=(-1.2, 0.0, 0.0, 0.0, 0.0))
    inner = np.linalg.norm(in_frame(points) - 129.5, axis=1) < 60
    pixels = in_frame(points[inner], folding).astype(np.float32)
    corner = Placed(np.arange(20), np.tile([[5.0, 5.0]], (20, 1)), np.tile(np.eye(2), (20, 1, 1)), np.ones(20, bool))
    monkeypatch.setattr(Aligner, "place", lambda self, pose, level, most=None: corner)
    with pytest.raises(GeometryError):
        folding.directions(corner.pixels)
    plain = solved(solve(pixels, points[inner], folding))
    looked = solved(solve(pixels, points[inner], folding, pictures=pictures(view, frame)))
    assert np.array_equal(pose_of(looked), pose_of(plain))


def test_a_point_that_is_found_or_matched_where_the_lens_has_no_inverse_is_no_inlier(
    view: RenderedView, frame: np.ndarray, points: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The others hold the pose."""
    folding = msgspec.structs.replace(LENS, distortion=(-1.2, 0.0, 0.0, 0.0, 0.0))
    inner = np.linalg.norm(in_frame(points) - 129.5, axis=1) < 60
    pixels, count = in_frame(points[inner], folding), int(inner.sum())
    pixels[:5] = 5.0
    placed = Placed(np.arange(count), pixels, np.tile(np.eye(2), (count, 1, 1)), np.ones(count, bool))
    monkeypatch.setattr(Aligner, "place", lambda self, pose, level, most=None: placed)
    for given in (None, pictures(view, frame)):
        config = PnpConfig(landmarks=0)
        result = solved(solve(pixels.astype(np.float32), points[inner], folding, config, pictures=given))
        assert translation_error(pose_of(result), TRUTH) < 1e-3
        assert not result.inliers[:5].any()
        assert result.inliers[5:].all()


def test_points_out_of_sight_are_not_looked_for(view: RenderedView, frame: np.ndarray, points: np.ndarray) -> None:
    behind = TRUTH.copy()
    behind[2, 3] = -10.0
    aligner = Aligner(pictures(view, frame), points, LENS, PnpConfig())
    assert len(aligner.place(behind, 0).index) == 0
    assert len(aligner.place(exp_se3([50.0, 0, 0, 0, 0, 0]) @ TRUTH, 2).index) == 0


def test_the_slopes_of_a_plane_are_its_own_and_do_not_cross_an_edge() -> None:
    y, x = np.mgrid[0:40, 0:50].astype(np.float64)
    depth = 1 / (0.5 + 0.004 * x - 0.002 * y)
    depth[:, 30:] *= 3
    depth[:, 45:] = 0
    pixels = np.array([[10.0, 10.0], [29.0, 20.0], [0.0, 39.0], [44.0, 5.0], [47.0, 5.0]])
    slopes = inverse_depth_slopes(depth, pixels)
    np.testing.assert_allclose(slopes[:3], [[0.004, -0.002]] * 3, atol=1e-9)
    np.testing.assert_allclose(slopes[3], [0.004 / 3, -0.002 / 3], atol=1e-9)
    assert not slopes[4].any()
