"""Cameras whose truth is known, disturbed, and adjusted."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.papered_room import cameras_around, disturbed, shared, worst

from fieldpose.stages.geometry import Camera
from fieldpose.stages.structure.adjustment import FEWEST_SEEN, adjust
from fieldpose.stages.structure.colmap import PIXEL_CENTRE, Freedom, from_colmap, to_colmap
from fieldpose.stages.structure.posed import PosedCameras
from fieldpose.stages.structure.similarity import align

CAMERA = Camera(640, 480, 520.0, 520.0, 321.5, 238.5)
LENSES = {
    "pinhole": CAMERA,
    "one coefficient": msgspec.structs.replace(CAMERA, distortion=(-0.1, 0.0, 0.0, 0.0, 0.0)),
    "radial": msgspec.structs.replace(CAMERA, distortion=(-0.1, 0.02, 0.0, 0.0, 0.0)),
    "two focal lengths": msgspec.structs.replace(CAMERA, fy=515.0),
    "OpenCV": msgspec.structs.replace(CAMERA, fy=515.0, distortion=(-0.1, 0.02, 0.001, -0.002, 0.0)),
    "sixth degree": msgspec.structs.replace(CAMERA, distortion=(-0.1, 0.02, 0.001, -0.002, 0.01)),
}


def with_focal(posed: PosedCameras, factor: float) -> PosedCameras:
    cameras = tuple(msgspec.structs.replace(c, fx=factor * c.fx, fy=factor * c.fy) for c in posed.cameras)
    return PosedCameras(cameras, posed.cam_from_object)


@pytest.mark.parametrize("freedom", ["poses", "focal", "distortion"])
@pytest.mark.parametrize("lens", list(LENSES))
def test_colmap_sees_points_where_we_do(lens: str, freedom: Freedom) -> None:
    camera = LENSES[lens]
    points = np.random.default_rng(0).uniform((-0.5, -0.4, 1), (0.5, 0.4, 1), (20, 3))
    theirs = to_colmap(camera, 1, freedom)
    np.testing.assert_allclose(theirs.img_from_cam(points) - PIXEL_CENTRE, camera.project(points), atol=1e-9)
    assert from_colmap(theirs, camera) == camera


@pytest.mark.parametrize("lens", ["pinhole", "radial", "OpenCV"])
def test_disturbed_cameras_are_mended(lens: str) -> None:
    truth = cameras_around(LENSES[lens], 24)
    tracks = shared(truth, 1500, wrong=0.05)
    found = adjust(with_focal(disturbed(truth, 0.5, 0.02), 1.1), tracks, "focal")
    aligned = PosedCameras(
        found.cameras, align(found.cam_from_object, truth.cam_from_object).of_poses(found.cam_from_object)
    )
    degrees, length = worst(aligned, truth)
    assert degrees < 0.15
    assert length < 0.008
    assert len(set(found.cameras)) == 1
    assert found.cameras[0].fx == pytest.approx(520, rel=2e-3)
    assert (found.cameras[0].fx == found.cameras[0].fy) == (lens != "OpenCV")


def test_frame_and_unit_stay_the_given_ones() -> None:
    truth = cameras_around(CAMERA, 24)
    given_ = disturbed(truth, 0.5, 0.02)
    found = adjust(given_, shared(truth, 1000), "poses")
    similarity = align(found.cam_from_object, given_.cam_from_object)
    assert similarity.scale == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(similarity.rotation, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(similarity.translation, 0, atol=1e-6)
    degrees, length = worst(found, truth)
    assert degrees < 0.5
    assert length < 0.02


@settings(max_examples=5)
@given(st.integers(0, 1000))
def test_the_same_input_has_the_same_result(seed: int) -> None:
    truth = cameras_around(CAMERA, 8, seed)
    tracks, given_ = shared(truth, 600, seed=seed), disturbed(truth, 0.3, 0.01, seed)
    first, second = adjust(given_, tracks, "focal"), adjust(given_, tracks, "focal")
    assert first.cameras == second.cameras
    assert np.array_equal(first.cam_from_object, second.cam_from_object)


def test_distortion_is_found_where_it_may_be() -> None:
    truth = cameras_around(LENSES["one coefficient"], 24)
    tracks = shared(truth, 1500)
    plain = PosedCameras((CAMERA,) * 24, truth.cam_from_object)
    found = adjust(plain, tracks, "distortion")
    assert found.cameras[0].distortion[0] == pytest.approx(-0.1, abs=0.01)
    assert adjust(plain, tracks, "focal").cameras[0].distortion == CAMERA.distortion


def test_each_of_several_cameras_is_found() -> None:
    truth = cameras_around(CAMERA, 24)
    longer = msgspec.structs.replace(CAMERA, fx=700.0, fy=700.0)
    truth = PosedCameras((CAMERA, longer) * 12, truth.cam_from_object)
    found = adjust(with_focal(truth, 1.05), shared(truth, 3000), "focal")
    assert len(set(found.cameras)) == 2
    assert [camera.fx for camera in found.cameras[:2]] == pytest.approx([520, 700], rel=4e-3)


def test_an_image_that_shares_little_stays_where_it_is() -> None:
    truth = cameras_around(CAMERA, 24)
    tracks = shared(truth, 1500)
    of_first = np.flatnonzero(tracks.image == 0)
    hidden = np.isin(np.arange(len(tracks.image)), of_first[FEWEST_SEEN - 1 :])
    given_ = with_focal(disturbed(truth, 0.5, 0.02), 1.1)
    found = adjust(given_, tracks.without(hidden), "focal")
    assert np.array_equal(found.cam_from_object[0], given_.cam_from_object[0])
    assert found.cameras[0] == found.cameras[1]
    assert not np.array_equal(found.cam_from_object[1], given_.cam_from_object[1])
