"""Where to look when nothing is known of the camera, and in which order."""

from __future__ import annotations

import numpy as np
import pytest
from support.tracking_world import on_sphere, ring_of_views

from fieldpose.errors import ConfigError
from fieldpose.stages.geometry import Limit, pairwise, rotation_error_deg, translation_error
from fieldpose.stages.nerf.training_views import TrainingViews
from fieldpose.stages.tracking.search import Keyframes, Relocaliser, farthest_point_order, nearest_first

VIEWS = ring_of_views()
NO_VIEWS = TrainingViews((), np.zeros((0, 4, 4)))


def test_nearest_first_lie_apart_from_the_guess_and_each_other() -> None:
    limit, guess = Limit(25.0, 2.0), on_sphere(3, 32)
    order = nearest_first(VIEWS.cam_from_object, guess, limit)
    distances = pairwise(guess[None], VIEWS.cam_from_object, limit)[0]
    assert list(distances[order]) == sorted(distances[order])
    chosen = np.concatenate([guess[None], VIEWS.cam_from_object[order]])
    assert (pairwise(chosen, chosen, limit) + 9 * np.eye(len(chosen))).min() > 1.0
    assert pairwise(VIEWS.cam_from_object, chosen, limit).min(axis=1).max() <= 1.0
    assert nearest_first(np.zeros((0, 4, 4)), guess, limit) == []


def test_farthest_points_cover_all_views_and_are_spread() -> None:
    limit = Limit(40.0, 3.0)
    order = farthest_point_order(VIEWS.cam_from_object, limit)
    chosen = VIEWS.cam_from_object[order]
    assert pairwise(VIEWS.cam_from_object, chosen, limit).min(axis=1).max() <= 1.0
    assert len(order) < len(VIEWS.names) / 2
    among = pairwise(chosen, chosen, limit)
    assert (among + 9 * np.eye(len(order))).min() > 1.0
    assert farthest_point_order(np.zeros((0, 4, 4)), limit) == []


def test_distances_agree_with_the_errors_of_geometry() -> None:
    a, b = on_sphere(0, 20), on_sphere(30, 40, 5.0)
    limit = Limit(10.0, 2.0)
    expected = max(rotation_error_deg(a, b) / 10, translation_error(a, b) / 2)
    assert limit.distance_ratio(a, b) == pytest.approx(expected)
    assert pairwise(a[None], b[None], limit)[0, 0] == pytest.approx(expected)


def test_scale_is_the_spread_of_the_cameras() -> None:
    centred = TrainingViews(tuple("abcd"), np.stack([on_sphere(a, 0) for a in (0, 90, 180, 270)]))
    assert centred.scale == pytest.approx(4.0)
    assert TrainingViews(("a",), np.eye(4)[None]).scale == 1.0


def test_relocalisation_alternates_between_near_poses_and_training_views() -> None:
    near = [on_sphere(1, 1), on_sphere(2, 2)]
    relocaliser = Relocaliser(VIEWS, Limit(40.0, 3.0), near)
    tried = [relocaliser.next() for _ in range(2 * relocaliser.lap)]
    assert all(tried[i] is near[i // 2 % 2] for i in range(0, len(tried), 2))
    views = {pose.tobytes() for pose in tried[1::2]}
    assert len(views) == relocaliser.lap - 2
    relocaliser.push(pushed := on_sphere(3, 3))
    assert relocaliser.next() is pushed
    assert relocaliser.next() is not pushed


def test_keyframes_lie_apart_and_the_oldest_go_first() -> None:
    keyframes = Keyframes(Limit(10.0, 1.0), capacity=3)
    poses = [on_sphere(azimuth, 0) for azimuth in (0, 5, 30, 60, 90)]
    for pose in poses:
        keyframes.add(pose)
    assert len(keyframes) == 3
    assert keyframes.newest(2)[0] is poses[4]
    assert keyframes.nearest(on_sphere(0, 0), otherwise=poses[0]) is poses[2]
    assert Keyframes(Limit(10.0, 1.0), 3).nearest(poses[1], otherwise=poses[0]) is poses[0]


def test_relocalisation_begins_with_what_looks_like_the_frame_and_goes_on_elsewhere() -> None:
    relocaliser = Relocaliser(VIEWS, Limit(40.0, 3.0))
    likely = [on_sphere(5, 5), on_sphere(6, 6), on_sphere(7, 7)]

    def place(pose: np.ndarray) -> int | None:
        return next((i for i, other in enumerate(likely) if (pose == other).all()), None)

    assert place(relocaliser.next()) is None
    tried = [place(relocaliser.next([pose.copy() for pose in likely])) for _ in range(8)]
    assert tried == [0, None, 1, None, 2, None, 0, None]
    assert place(relocaliser.next([likely[2], likely[0]])) == 2


def test_a_pose_that_was_found_comes_once_and_before_what_looks_like_the_frame() -> None:
    relocaliser, likely = Relocaliser(VIEWS, Limit(40.0, 3.0)), [on_sphere(5, 5)]
    assert not relocaliser.has_found
    relocaliser.push(pushed := on_sphere(3, 3))
    assert relocaliser.has_found
    assert relocaliser.next(likely) is pushed
    assert not relocaliser.has_found
    assert relocaliser.next(likely) is likely[0]


def test_relocalisation_that_begins_again_forgets_what_was_found_and_tried() -> None:
    relocaliser, likely = Relocaliser(VIEWS, Limit(40.0, 3.0)), [on_sphere(5, 5)]
    assert relocaliser.next(likely) is likely[0]
    relocaliser.push(on_sphere(3, 3))
    relocaliser.restart([near := on_sphere(1, 1)])
    assert not relocaliser.has_found
    assert relocaliser.next(likely) is likely[0]
    assert relocaliser.next() is near


def test_relocalisation_needs_a_pose_to_try() -> None:
    with pytest.raises(ConfigError, match="--guess"):
        Relocaliser(NO_VIEWS, Limit(40.0, 3.0))
    near = on_sphere(1, 1)
    alone = Relocaliser(NO_VIEWS, Limit(40.0, 3.0), [near])
    assert [alone.next() is near for _ in range(3)] == [True] * 3
