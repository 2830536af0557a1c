"""The way of a turntable's camera."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from support.posed_images import poses_ahead, poses_around
from support.surfaces import ball_field

from fieldpose.stages.geometry import camera_centres, is_rigid, look_at
from fieldpose.stages.nerf.metadata import FieldMetadata, TrainingCamera
from fieldpose.stages.nerf.tour import tour


def seen_from(poses: list[np.ndarray], contracted: bool = False, size: tuple[int, int] = (65, 49)) -> FieldMetadata:
    """Metadata of a field that was learnt from these poses."""
    cameras = [
        TrainingCamera(f"{i}", *size, 60.0, 60.0, 32.0, 24.0, (0.1, 0.0, 0.0, 0.0, 0.0), tuple(pose.ravel().tolist()))
        for i, pose in enumerate(poses)
    ]
    metadata = ball_field(views=1).metadata
    space = msgspec.structs.replace(metadata.space, contracted=contracted)
    return msgspec.structs.replace(metadata, cameras=cameras, space=space)


def test_a_surrounded_object_is_gone_around_once_at_one_height() -> None:
    way = tour(seen_from(poses_around(9)), 40, 400)
    centres = camera_centres(np.array(way.poses))
    assert way.order == list(range(40))
    np.testing.assert_allclose(np.linalg.norm(centres, axis=1), 4, rtol=1e-6)
    np.testing.assert_allclose(centres[:, 2], 2.4, rtol=1e-6)
    steps = np.diff(np.unwrap(np.arctan2(centres[:, 1], centres[:, 0]), period=2 * np.pi))
    np.testing.assert_allclose(np.abs(steps), 2 * np.pi / 40, rtol=1e-6)
    middle = np.array(way.poses) @ (0, 0, 0, 1)
    np.testing.assert_allclose(middle[:, :2], 0, atol=1e-6)
    assert (middle[:, 2] > 0).all()


@pytest.mark.parametrize("contracted", [True, False])
def test_what_is_seen_from_one_side_is_shown_to_and_fro_between_its_views(contracted: bool) -> None:
    poses = [look_at((4 * np.cos(a), 4 * np.sin(a), 1 + 0.3 * (i % 2)), (0, 0, 0), (0, 0, 1))
             for i, a in enumerate(np.linspace(0, 2, 12))]  # fmt: skip
    way = tour(seen_from(poses, contracted), 60, 400)
    assert len(way.order) == 60
    assert way.order[:31] == list(range(31))
    assert all(way.order[i] == way.order[60 - i] for i in range(1, 60))
    centres = camera_centres(np.array(way.poses))
    around = np.sort(np.arctan2(centres[[0, -1], 1], centres[[0, -1], 0]))
    assert around[0] < 0.3
    assert around[1] > 1.7
    assert ((centres[:, 2] > 0.95) & (centres[:, 2] < 1.35)).all()
    hops = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    assert hops[0] < 0.2 * hops.max()
    assert all(is_rigid(pose) for pose in way.poses)


@pytest.mark.parametrize("count", [1, 2, 8])
def test_few_views_are_enough(count: int) -> None:
    for metadata in (seen_from(poses_ahead(count), True), seen_from(poses_around(count))):
        way = tour(metadata, 20, 400)
        assert len(way.order) == 20
        assert all(is_rigid(pose) for pose in way.poses)


def test_twins_of_a_view_are_no_obstacle() -> None:
    pose = look_at((0, -4, 1), (0, 0, 0), (0, 0, 1))
    way = tour(seen_from([pose, pose, pose], True), 20, 400)
    np.testing.assert_allclose(way.poses[7], pose, atol=1e-6)


def test_the_video_s_sides_are_even_and_not_larger_than_wanted() -> None:
    camera = tour(seen_from(poses_around(9)), 20, 40).camera
    assert (camera.width % 2, camera.height % 2, max(camera.width, camera.height)) == (0, 0, 40)
    assert not camera.is_distorted
    assert (tour(seen_from(poses_around(9)), 20, 400).camera.width, 48) == (64, 48)
