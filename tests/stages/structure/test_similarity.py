"""Bringing cameras into the frame of others."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from support.papered_room import cameras_around, cameras_before_a_wall, disturbed

from fieldpose.stages.geometry import Camera, Similarity, camera_centres, rotation_about
from fieldpose.stages.structure.similarity import align

CAMERA = Camera(320, 240, 250.0, 250.0, 159.5, 119.5)
POSES = cameras_around(CAMERA, 12).cam_from_object


@st.composite
def similarities(draw: st.DrawFn) -> Similarity:
    numbers = st.floats(-5, 5)
    axis = np.array([draw(numbers), draw(numbers), draw(numbers) + 11])
    rotation = rotation_about(axis, draw(st.floats(-3.1, 3.1)))[:3, :3]
    return Similarity(np.exp(draw(st.floats(-3, 3))), rotation, np.array([draw(numbers) for _ in range(3)]))


@given(similarities())
def test_what_was_moved_is_brought_back(moved: Similarity) -> None:
    away = moved.of_poses(POSES)
    np.testing.assert_allclose(align(away, POSES).of_poses(away), POSES, atol=1e-6)
    found = align(POSES, away)
    np.testing.assert_allclose(found.scale, moved.scale, rtol=1e-6)
    np.testing.assert_allclose(found.rotation, moved.rotation, atol=1e-6)
    np.testing.assert_allclose(found.translation, moved.translation, atol=1e-5)


@given(similarities())
def test_points_are_seen_as_before(moved: Similarity) -> None:
    points = np.random.default_rng(0).normal(size=(5, 3)) + 3
    there = moved.scale * points @ moved.rotation.T + moved.translation
    for pose, away in zip(POSES, moved.of_poses(POSES), strict=True):
        before, after = points @ pose[:3, :3].T + pose[:3, 3], there @ away[:3, :3].T + away[:3, 3]
        np.testing.assert_allclose(after, moved.scale * before, atol=1e-9 * (1 + np.abs(after).max()))


@given(similarities(), similarities())
def test_one_after_the_other_is_one_and_its_inverse_undoes_it(first: Similarity, second: Similarity) -> None:
    points = np.random.default_rng(1).normal(size=(5, 3))
    both = second.after(first)
    size = 1 + np.abs(both.translation).max() + both.scale
    np.testing.assert_allclose(both.of_points(points), second.of_points(first.of_points(points)), atol=1e-11 * size)
    again = both.inverse().of_points(both.of_points(points))
    np.testing.assert_allclose(again, points, atol=1e-11 * size / both.scale)
    np.testing.assert_array_equal(Similarity.identity().after(first).of_points(points), first.of_points(points))


def test_cameras_that_are_as_wanted_stay() -> None:
    found = align(POSES, POSES)
    assert (found.scale, np.abs(found.translation).max()) == (1.0, 0.0)
    np.testing.assert_allclose(found.rotation, np.eye(3), atol=1e-12)


def test_outliers_turn_nothing() -> None:
    astray = POSES.copy()
    astray[:3] = cameras_before_a_wall(CAMERA, 3).cam_from_object
    found = align(astray, POSES)
    np.testing.assert_allclose(found.of_poses(astray)[3:], POSES[3:], atol=0.01)


def test_errors_of_single_cameras_average_out() -> None:
    given_ = disturbed(cameras_around(CAMERA, 100), 0.5, 0.02).cam_from_object
    found = align(cameras_around(CAMERA, 100).cam_from_object, given_)
    assert abs(found.scale - 1) < 0.02 / 10 / 0.7 * 3
    assert np.abs(found.translation).max() < 0.02 / 10 * 3


def test_cameras_in_one_place_keep_their_scale() -> None:
    turned = POSES.copy()
    turned[:, :3, 3] = 0
    around = rotation_about((1, 2, 3), 0.3)[:3, :3]
    found = align(Similarity(1.0, around, np.zeros(3)).of_poses(turned), turned)
    assert found.scale == 1.0
    np.testing.assert_allclose(found.rotation, around.T, atol=1e-6)


def test_cameras_along_a_line_are_turned_by_their_axes() -> None:
    row = np.repeat(POSES[:1], 5, axis=0)
    centres = np.linspace(0, 1, 5)[:, None] * (1.0, 0, 0)
    row[:, :3, 3] = -np.einsum("nij,nj->ni", row[:, :3, :3], centres)
    moved = Similarity(2.0, rotation_about((1, 0, 0), 0.5)[:3, :3], np.ones(3))
    away = moved.of_poses(row)
    np.testing.assert_allclose(align(away, row).of_poses(away), row, atol=1e-6)
    assert np.ptp(camera_centres(away)[:, 0]) > 1.9
