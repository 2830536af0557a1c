"""A marker on a papered wall tells what a metre is, where, and which way up."""

from __future__ import annotations

import numpy as np
import pytest
from support.papered_room import cameras_before_a_wall, photograph
from support.wall_marker import CORNERS, MIDDLE, NUMBER, SIZE, with_marker

from fieldpose.stages.geometry import Camera, Similarity, camera_centres
from fieldpose.stages.structure.markers import Seen, find_markers, place_marker
from fieldpose.stages.structure.posed import PosedCameras

CAMERA = Camera(640, 480, 520.0, 520.0, 319.5, 239.5, (-0.05, 0.0, 0.0, 0.0, 0.0))
TRUTH = cameras_before_a_wall(CAMERA, 8)


@pytest.fixture(scope="module")
def images() -> list[np.ndarray]:
    return [with_marker(photograph(CAMERA, pose), CAMERA, pose) for pose in TRUTH.cam_from_object]


def test_corners_are_found_where_they_are(images: list[np.ndarray]) -> None:
    found = 0
    for image, pose in zip(images, TRUTH.cam_from_object, strict=True):
        for marker in find_markers(image, "4x4"):
            assert marker.number == NUMBER
            there = CAMERA.project(CORNERS @ pose[:3, :3].T + pose[:3, 3])
            assert np.linalg.norm(marker.corners - there, axis=1).max() < 1.0
            found += 1
    assert found >= 6
    assert find_markers(images[0], "tag36h11") == []


def test_frame_and_metres_are_the_markers(images: list[np.ndarray]) -> None:
    scale = 0.3
    mapped = Similarity(scale, np.array([[0, 1.0, 0], [0, 0, 1], [1, 0, 0]]), np.array([3.0, -1, 2]))
    posed = PosedCameras(TRUTH.cameras, mapped.of_poses(TRUTH.cam_from_object))
    marker = place_marker(posed, [find_markers(image, "4x4") for image in images], SIZE)
    assert marker is not None
    assert marker.number == NUMBER
    assert marker.images >= 6
    assert marker.error_px < 0.6
    corners = marker.object_from_map.of_points(mapped.of_points(CORNERS))
    half = SIZE / 2
    np.testing.assert_allclose(
        corners, [(-half, half, 0), (half, half, 0), (half, -half, 0), (-half, -half, 0)], atol=0.01
    )
    assert marker.object_from_map.scale == pytest.approx(1 / scale, rel=0.01)
    centres = camera_centres(marker.object_from_map.of_poses(posed.cam_from_object))
    assert (centres[:, 2] > 0).all()


def seen_at(pose: np.ndarray, number: int, corners: np.ndarray = CORNERS) -> Seen:
    return Seen(number, CAMERA.project(corners @ pose[:3, :3].T + pose[:3, 3]))


def test_what_is_no_square_or_seldom_seen_is_none() -> None:
    poses = TRUTH.cam_from_object
    assert place_marker(TRUTH, [[seen_at(p, 1)] if i < 2 else [] for i, p in enumerate(poses)], SIZE) is None
    stretched = MIDDLE + (CORNERS - MIDDLE) * (1, 1.3, 1)
    assert place_marker(TRUTH, [[seen_at(p, 1, stretched)] for p in poses], SIZE) is None
    both = place_marker(TRUTH, [[seen_at(p, 1, stretched), seen_at(p, 2)] for p in poses], SIZE)
    assert both is not None
    assert both.number == 2
    twice = [[seen_at(p, 3), seen_at(p, 3, CORNERS + 0.5)] for p in poses]
    assert place_marker(TRUTH, twice, SIZE) is None
