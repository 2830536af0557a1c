"""Following single frames, on a scene whose geometry is known exactly."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from support.analytic_scene import camera, viewpoint
from support.followed import VIEW, VIEWPOINTS, add_view, grey_and_depth, photograph, pyramid_of

from fieldpose.errors import ConfigError
from fieldpose.stages.alignment.images import FramePyramid
from fieldpose.stages.alignment.landmarks import landmarks
from fieldpose.stages.alignment.placing import Warped, warped
from fieldpose.stages.alignment.views import ViewPoints
from fieldpose.stages.following.choice import chosen_points
from fieldpose.stages.following.config import KEYFRAMES, LEVELS, FollowingConfig
from fieldpose.stages.following.core import Followed, Follower
from fieldpose.stages.geometry import exp_se3, inverse, log_se3, perturb, rotation_error_deg, translation_error

TRUTH = viewpoint(25.0, 38.0)
ELSEWHERE = viewpoint(200.0, 15.0)
NEAR = perturb(TRUTH, np.random.default_rng(0), (2.0, 2.0), 0.04)
POINTS = 400


def remembering(*poses: np.ndarray, views: int = 24) -> Follower:
    follower = Follower(FollowingConfig(views=views))
    for number, pose in enumerate(poses):
        add_view(follower, str(number), pose)
    return follower


@pytest.fixture(scope="module")
def follower() -> Follower:
    return remembering(*VIEWPOINTS)


@pytest.fixture(scope="module")
def frame() -> np.ndarray:
    return photograph(TRUTH)


def at_truth(pose: np.ndarray, frame: FramePyramid) -> tuple[ViewPoints, Warped]:
    """Points of a view from there, and where the true pose puts them."""
    grey, depth = grey_and_depth(pose)
    view = ViewPoints.of(grey, depth, VIEW, pose, landmarks(grey, depth, VIEW, pose, 450), LEVELS)
    return view, warped(view, frame, TRUTH)


def followed(follower: Follower, frame: np.ndarray, *starts: np.ndarray, points: int = POINTS) -> Followed:
    result = follower.follow(pyramid_of(frame), starts, points)
    assert result is not None
    return result


def assert_near(result: Followed, angle_deg: float, distance: float) -> None:
    assert rotation_error_deg(result.cam_from_object, TRUTH) < angle_deg
    assert translation_error(result.cam_from_object, TRUTH) < distance


@pytest.mark.parametrize("off", [0.0, 1.0, 3.0, 5.0])
@pytest.mark.parametrize("seed", range(3))
def test_a_frame_is_followed_from_some_degrees_off(
    follower: Follower, frame: np.ndarray, off: float, seed: int
) -> None:
    start = perturb(TRUTH, np.random.default_rng(seed), (off, off), 0.02 * off)
    result = followed(follower, frame, start)
    assert_near(result, 0.05, 0.004)
    assert result.found.mean() > 0.85
    assert (result.level, result.longer_side) == (0, 200)
    assert result.residual_px < 0.6


@pytest.mark.parametrize("direction", [(1, 0), (0, 1), (-1, 0), (0, -1)])
def test_a_camera_that_has_turned_by_ten_pixels_is_found(
    follower: Follower, frame: np.ndarray, direction: tuple[int, int]
) -> None:
    turn = 10 / VIEW.fx * np.array(direction)
    assert_near(followed(follower, frame, exp_se3([0, 0, 0, *turn, 0]) @ TRUTH), 0.05, 0.004)


@pytest.mark.parametrize("first", [True, False], ids=["first", "last"])
def test_of_several_starts_the_one_that_leads_to_the_pose_counts(
    follower: Follower, frame: np.ndarray, first: bool
) -> None:
    wrong = [viewpoint(60, 20), viewpoint(0, 55)]
    starts = [NEAR, *wrong] if first else [*wrong, NEAR]
    assert_near(followed(follower, frame, *starts), 0.05, 0.004)


@pytest.mark.parametrize("shade", [0, 128, 255])
def test_nothing_is_found_in_a_blank_frame(follower: Follower, frame: np.ndarray, shade: int) -> None:
    assert follower.follow(pyramid_of(np.full_like(frame, shade)), [TRUTH], POINTS) is None


def test_nothing_is_found_without_a_start_or_a_view(follower: Follower, frame: np.ndarray) -> None:
    assert follower.follow(pyramid_of(frame), [], POINTS) is None
    assert remembering().follow(pyramid_of(frame), [TRUTH], POINTS) is None


@pytest.mark.parametrize("seed", range(3))
def test_next_to_nothing_is_found_in_a_picture_of_something_else(
    follower: Follower, frame: np.ndarray, seed: int
) -> None:
    noise = np.random.default_rng(seed).integers(0, 256, frame.shape, np.uint8)
    for picture in (photograph(ELSEWHERE), cv2.GaussianBlur(noise, (0, 0), 2.0)):
        result = follower.follow(pyramid_of(picture), [TRUTH], POINTS)
        assert result is None or result.found.mean() < 0.15


def test_next_to_nothing_is_found_from_the_other_side(follower: Follower, frame: np.ndarray) -> None:
    result = follower.follow(pyramid_of(frame), [ELSEWHERE], POINTS)
    assert result is None or result.found.mean() < 0.15


@pytest.mark.parametrize("covered", [np.s_[:, :120], np.s_[:, 80:], np.s_[:120], np.s_[80:]])
def test_where_most_of_the_frame_is_covered_the_rest_tells_the_pose(
    follower: Follower, frame: np.ndarray, covered: tuple[slice, ...]
) -> None:
    """Three fifths of it, from either side."""
    hidden = frame.copy()
    hidden[covered] = 90
    result = followed(follower, hidden, NEAR)
    assert_near(result, 0.2, 0.012)
    assert 0.1 < result.found.mean() < 0.7
    grown = np.zeros(frame.shape, bool)
    grown[covered] = True
    x, y = np.rint(result.pixels).astype(int).T
    deep = cv2.erode(grown.astype(np.uint8), np.ones((13, 13), np.uint8))[y, x] > 0
    assert deep.sum() > 50
    assert result.found[deep].mean() < 0.05


@pytest.mark.parametrize(("contrast", "brightness"), [(0.6, 60), (0.3, 0), (1.0, -40)])
def test_brightness_and_contrast_leave_the_pose_as_it_is(
    follower: Follower, frame: np.ndarray, contrast: float, brightness: int
) -> None:
    changed = np.clip(frame * contrast + brightness, 0, 255).astype(np.uint8)
    result = followed(follower, changed, NEAR)
    assert_near(result, 0.05, 0.004)
    assert result.found.mean() > 0.8


@pytest.mark.parametrize(("blur_px", "coarse", "angle_deg", "distance"), [(1, 0, 0.1, 0.01), (4, 1, 0.8, 0.1)])
def test_a_blurred_frame_is_looked_at_as_coarsely_as_it_is(
    follower: Follower, frame: np.ndarray, blur_px: int, coarse: int, angle_deg: float, distance: float
) -> None:
    result = followed(follower, cv2.GaussianBlur(frame, (0, 0), blur_px), NEAR)
    assert result.level == coarse
    assert_near(result, angle_deg, distance)


def test_the_less_is_seen_the_less_certain_the_pose(follower: Follower, frame: np.ndarray) -> None:
    covered = frame.copy()
    covered[:, :120] = 90
    sharp, blurred, hidden, few = (
        followed(follower, frame, NEAR), followed(follower, cv2.GaussianBlur(frame, (0, 0), 2.0), NEAR),
        followed(follower, covered, NEAR), followed(follower, frame, NEAR, points=50),
    )  # fmt: skip
    for other in (blurred, hidden, few):
        assert np.trace(other.covariance) > 2 * np.trace(sharp.covariance)


@pytest.mark.parametrize("azimuth", [20.0, 25.0, 31.0, 37.0])
def test_the_covariance_covers_the_error(follower: Follower, azimuth: float) -> None:
    truth = viewpoint(azimuth, 38.0)
    result = followed(follower, photograph(truth), perturb(truth, np.random.default_rng(1), (1.0, 1.0), 0.02))
    for covariance in (result.covariance, result.noise):
        assert covariance.shape == (6, 6)
        np.testing.assert_allclose(covariance, covariance.T, rtol=1e-6, atol=1e-15)
        assert (np.linalg.eigvalsh(covariance) > 0).all()
    assert np.trace(result.noise) < np.trace(result.covariance)
    error = log_se3(result.cam_from_object @ inverse(truth))
    assert error @ np.linalg.solve(result.covariance, error) < 25


def test_it_tells_where_points_were_looked_for_and_which_were_found(follower: Follower, frame: np.ndarray) -> None:
    result = followed(follower, frame, NEAR)
    assert result.pixels.shape == (len(result.found), 2)
    assert result.pixels.dtype == np.float32
    assert result.found.dtype == bool
    assert len(result.found) <= POINTS
    assert ((result.pixels >= 0) & (result.pixels <= 199)).all()


@pytest.mark.parametrize("most", [8, 25, 100, 400])
def test_at_most_so_many_points_are_looked_for(follower: Follower, frame: np.ndarray, most: int) -> None:
    result = followed(follower, frame, NEAR, points=most)
    assert 0.9 * most <= len(result.found) <= most


def test_points_are_chosen_all_over_the_frame(follower: Follower, frame: np.ndarray) -> None:
    """Of the cells that any point is in, as many have one that is chosen as can have one."""

    def cells(points: int) -> np.ndarray:
        pixels = followed(follower, frame, TRUTH, points=points).pixels
        return np.unique(np.floor(pixels / 25).astype(int), axis=0)

    assert len(cells(60)) >= 0.85 * len(cells(1500))


def test_in_each_part_of_the_frame_the_first_view_comes_first(frame: np.ndarray) -> None:
    pyramid = pyramid_of(frame)
    first, second = (at_truth(pose, pyramid) for pose in VIEWPOINTS[:2])
    assert len(chosen_points([first, second], pyramid, 100).parts[0][1]) > 85
    assert len(chosen_points([second, first], pyramid, 100).parts[0][1]) > 85
    assert len(chosen_points([first, second], pyramid, 10_000)) == first[1].seen.sum() + second[1].seen.sum()
    assert len(chosen_points([], pyramid, 100)) == 0


def test_views_beyond_the_capacity_are_forgotten_the_longest_unused_first() -> None:
    follower = remembering(*VIEWPOINTS[:2], views=2)
    add_view(follower, "0", VIEWPOINTS[0])
    add_view(follower, "2", VIEWPOINTS[2])
    assert [view_id in follower for view_id in "012"] == [True, False, True]
    assert len(follower) == 2


def test_a_view_that_is_kept_stays_whatever_comes_after_it_until_too_many_are() -> None:
    follower = remembering(VIEWPOINTS[0], views=1)
    follower.keep("0")
    follower.keep("unknown")
    for number in range(1, KEYFRAMES + 1):
        add_view(follower, str(number), VIEWPOINTS[1])
        assert ("0" in follower, follower.keyframes) == (True, number)
        if number < KEYFRAMES:
            follower.keep(str(number))
    assert follower.angle(VIEWPOINTS[0]) < 1e-3
    follower.keep(str(KEYFRAMES))
    assert ("0" in follower, follower.keyframes, len(follower)) == (False, KEYFRAMES + 1, KEYFRAMES)


def test_a_view_that_is_added_twice_is_one() -> None:
    follower = remembering(VIEWPOINTS[0])
    add_view(follower, "0", VIEWPOINTS[1])
    assert len(follower) == 1
    assert follower.angle(VIEWPOINTS[0]) < 0.01


def test_a_view_without_anything_to_find_is_not_remembered() -> None:
    follower = Follower(FollowingConfig())
    blank = np.full((200, 200), 128, np.uint8)
    follower.add("plain", blank, np.full((200, 200), 3.0, np.float32), VIEW, TRUTH)
    follower.add("empty", photograph(TRUTH, VIEW), np.zeros((200, 200), np.float32), VIEW, TRUTH)
    assert len(follower) == 0


def test_the_farther_from_the_nearest_view_the_larger_the_angle() -> None:
    follower = remembering(viewpoint(20, 35))
    around = [follower.angle(viewpoint(azimuth, 35)) for azimuth in (20, 25, 35, 50, 80)]
    away = [follower.angle(viewpoint(20, 35, distance)) for distance in (4.0, 4.5, 5.5, 8.0)]
    closer = [follower.angle(viewpoint(20, 35, distance)) for distance in (4.0, 3.5, 3.0)]
    turned = [follower.angle(exp_se3([0, 0, 0, 0, angle, 0]) @ viewpoint(20, 35)) for angle in (0.0, 0.1, 0.3)]
    for angles in (around, away, closer, turned):
        assert angles[0] < 1e-6
        assert (np.diff(angles) > 0.01).all()
    assert remembering().angle(TRUTH) == np.inf
    add_view(follower, "near", viewpoint(50, 35))
    assert follower.angle(viewpoint(50, 35)) < 1e-6


def test_a_frame_that_views_saw_otherwise_is_less_certain(follower: Follower) -> None:
    near, far = (followed(follower, photograph(pose), pose) for pose in (viewpoint(25, 38), viewpoint(5, 38)))
    assert far.angle > near.angle + 0.1
    assert np.trace(far.covariance) > np.trace(near.covariance)


def test_settings_that_make_no_sense_are_refused() -> None:
    for name in ("landmarks", "views", "budget", "solve_ms", "fresh_deg", "lost_after", "weak_after"):
        with pytest.raises(ConfigError, match=name):
            FollowingConfig(**{name: -1})


@pytest.mark.parametrize("bent", [0.0, -0.25, 0.25])
def test_the_lens_is_the_frames_and_not_the_views(follower: Follower, bent: float) -> None:
    lens = camera(200, (bent, 0.0, 0.0, 0.0, 0.0))
    result = follower.follow(pyramid_of(photograph(TRUTH, lens), lens), [NEAR], POINTS)
    assert result is not None
    assert_near(result, 0.05, 0.004)
    assert result.found.mean() > 0.85
