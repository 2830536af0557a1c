"""Which images are matched, what becomes one track, and where tracks are."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from support.papered_room import cameras_around, photograph, shared

from fieldpose.stages.geometry import Camera
from fieldpose.stages.structure.features import Keypoints, find_keypoints
from fieldpose.stages.structure.matches import match_pairs
from fieldpose.stages.structure.pairs import FARTHER, NEAREST, WIDEST_DEG, choose_pairs
from fieldpose.stages.structure.posed import PosedCameras
from fieldpose.stages.structure.tracks import SHORTEST, Tracks, join_tracks
from fieldpose.stages.structure.triangulation import triangulate

CAMERA = Camera(320, 240, 250.0, 255.0, 159.5, 119.5, (-0.1, 0.02, 0.001, -0.001, 0.0))


def blank(counts: list[int]) -> list[Keypoints]:
    return [Keypoints(np.arange(2.0 * n).reshape(n, 2), np.zeros((n, 128), np.uint8)) for n in counts]


@given(st.integers(1, 60), st.integers(0, 5))
def test_pairs_are_few_different_and_face_alike(count: int, seed: int) -> None:
    poses = cameras_around(CAMERA, count, seed).cam_from_object
    pairs = choose_pairs(poses)
    assert pairs == sorted(set(pairs))
    assert all(0 <= i < j < count for i, j in pairs)
    assert len(pairs) <= count * (NEAREST + FARTHER)
    for i, j in pairs:
        assert np.degrees(np.arccos(np.clip(poses[i, 2, :3] @ poses[j, 2, :3], -1, 1))) <= WIDEST_DEG


def test_pairs_depend_on_no_unit() -> None:
    poses = cameras_around(CAMERA, 40).cam_from_object
    larger = poses.copy()
    larger[:, :3, 3] *= 1000
    assert choose_pairs(larger) == choose_pairs(poses)


def test_few_images_are_all_matched() -> None:
    poses = np.repeat(cameras_around(CAMERA, 1).cam_from_object, 5, axis=0)
    assert len(choose_pairs(poses)) == 10


def test_matches_in_a_chain_are_one_track() -> None:
    links = [np.array([[0, 1]]), np.array([[1, 2], [0, 0]])]
    tracks = join_tracks(blank([3, 3, 3]), [(0, 1), (1, 2)], links)
    assert tracks.count == 1
    assert tracks.image.tolist() == [0, 1, 2]
    assert tracks.pixels.tolist() == [[0, 1], [2, 3], [4, 5]]


def test_a_track_that_shows_an_image_twice_is_none() -> None:
    links = [np.array([[0, 0]]), np.array([[0, 0]]), np.array([[0, 1]])]
    assert join_tracks(blank([2, 2, 2]), [(0, 1), (0, 2), (1, 2)], links).count == 0


def test_nothing_shared_is_no_track() -> None:
    nothing = np.zeros((0, 2), np.int64)
    tracks = join_tracks(blank([2, 0]), [(0, 1)], [nothing])
    assert (tracks.count, len(triangulate(cameras_around(CAMERA, 2), tracks).points)) == (0, 0)


@given(st.integers(0, 100), st.floats(0, 1))
def test_what_is_left_of_tracks_is_long_enough_and_numbered_anew(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    tracks = shared(cameras_around(CAMERA, 8), 60, seed=seed)
    left = tracks.without(rng.random(len(tracks.track)) < share)
    assert (np.bincount(left.track, minlength=left.count) >= SHORTEST).all()
    some = tracks.chosen(rng.random(tracks.count) < share)
    for kept in (left, some):
        assert np.array_equal(np.unique(kept.track), np.arange(kept.count))
        assert set(map(tuple, kept.pixels)) <= set(map(tuple, tracks.pixels))


def test_points_are_placed_where_they_are() -> None:
    posed = cameras_around(CAMERA, 12)
    found = triangulate(posed, shared(posed, 300, noise_px=0.0))
    assert np.median(np.abs(np.abs(found.points).max(axis=1) - 2.0)) < 1e-5
    assert np.median(found.error_px) < 1e-3


def test_a_wrong_observation_stands_out() -> None:
    posed = cameras_around(CAMERA, 20)
    tracks = shared(posed, 200, noise_px=0.0)
    many = np.flatnonzero(np.bincount(tracks.track) >= 5)
    first = np.searchsorted(tracks.track, many)
    pixels = tracks.pixels.copy()
    pixels[first, 1] += 30
    error = triangulate(posed, Tracks(tracks.track, tracks.image, pixels)).error_px
    right = np.isin(tracks.track, many)
    right[first] = False
    assert np.median(error[first]) > 20
    assert np.median(error[right]) < 1


def test_points_behind_a_camera_are_infinitely_wrong() -> None:
    posed = cameras_around(CAMERA, 12)
    tracks = shared(posed, 100)
    turned = posed.cam_from_object.copy()
    turned[:, 0] *= -1
    turned[:, 2] *= -1
    facing_away = PosedCameras(posed.cameras, turned)
    mirrored = Tracks(tracks.track, tracks.image, tracks.pixels)
    assert np.isinf(triangulate(facing_away, mirrored).error_px).any()


def test_keypoints_of_two_photographs_are_matched_rightly() -> None:
    posed = cameras_around(CAMERA, 40)
    images = [photograph(CAMERA, posed.cam_from_object[i]) for i in (0, 1)]
    keypoints = [find_keypoints(image, 500) for image in images]
    assert all(100 < len(points) <= 500 for points in keypoints)
    (matches,) = match_pairs(keypoints, [(0, 1)], 1)
    assert len(matches) > 50
    pixels = [keypoints[k].pixels[matches[:, k]] for k in (0, 1)]
    tracks = Tracks(
        np.repeat(np.arange(len(matches)), 2), np.tile([0, 1], len(matches)), np.stack(pixels, 1).reshape(-1, 2)
    )
    assert np.median(triangulate(posed.chosen(np.arange(40) < 2), tracks).error_px) < 0.5


def test_keypoints_lie_on_the_object_alone() -> None:
    image = photograph(CAMERA, cameras_around(CAMERA, 1).cam_from_object[0])
    alpha = np.zeros((240, 320, 1), np.uint8)
    alpha[60:180, 100:220] = 255
    points = find_keypoints(np.concatenate([image, alpha], axis=2), 500)
    assert len(points) > 20
    assert (points.pixels > (103, 63)).all()
    assert (points.pixels < (216, 176)).all()


def test_a_plain_image_has_no_keypoints() -> None:
    assert len(find_keypoints(np.full((50, 60, 3), 90, np.uint8), 500)) == 0
