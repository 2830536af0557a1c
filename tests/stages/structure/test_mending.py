"""Whether cameras are mended or left alone, from tracks and from photographs."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from support.papered_room import cameras_around, cameras_before_a_wall, disturbed, photograph, shared, worst

from fieldpose.stages.geometry import Camera
from fieldpose.stages.structure.mending import Mending, mend, mend_by_tracks
from fieldpose.stages.structure.posed import PosedCameras
from fieldpose.stages.structure.similarity import align
from fieldpose.stages.structure.tracks import Tracks

CAMERA = Camera(640, 480, 520.0, 520.0, 319.5, 239.5)
AROUND = cameras_around(CAMERA, 24)
TRACKS = shared(AROUND, 2000, wrong=0.05)


def aligned(mending: Mending, truth: PosedCameras) -> PosedCameras:
    poses = mending.posed.cam_from_object
    return PosedCameras(mending.posed.cameras, align(poses, truth.cam_from_object).of_poses(poses))


def test_good_cameras_are_kept_to_the_bit() -> None:
    found = mend_by_tracks(AROUND, TRACKS, 640)
    assert found.verdict == "fit"
    assert found.posed is AROUND
    assert found.before_px is not None
    assert found.before_px < 0.5
    assert (found.rotation_deg, found.translation) == (None, None)


@pytest.mark.parametrize("degrees", [0.2, 0.5, 5.0])
def test_disturbed_cameras_are_mended(degrees: float) -> None:
    given = disturbed(AROUND, degrees, degrees / 20)
    found = mend_by_tracks(given, TRACKS, 640)
    assert found.verdict == "adjusted"
    assert not found.unsupported.any()
    turned, moved = worst(aligned(found, AROUND), AROUND)
    assert turned < 0.25
    assert moved < 0.02
    assert found.before_px is not None
    assert found.after_px is not None
    assert found.after_px < 0.5 < found.before_px
    assert found.rotation_deg is not None
    assert found.rotation_deg.median == pytest.approx(degrees, rel=0.3)


def test_a_disturbance_that_no_pixel_shows_is_left() -> None:
    given = disturbed(AROUND, 0.03, 0.001)
    assert mend_by_tracks(given, TRACKS, 100).posed is given


def test_a_wrong_focal_length_alone_is_mended() -> None:
    longer = msgspec.structs.replace(CAMERA, fx=1.1 * CAMERA.fx, fy=1.1 * CAMERA.fy)
    found = mend_by_tracks(PosedCameras((longer,) * 24, AROUND.cam_from_object), TRACKS, 640)
    assert found.verdict == "adjusted"
    assert found.posed.cameras[0].fx == pytest.approx(520, rel=2e-3)
    assert found.posed.cameras[0].distortion == CAMERA.distortion
    assert np.array_equal(found.posed.cam_from_object, AROUND.cam_from_object)


def test_a_focal_length_that_depths_make_up_for_is_mended_too() -> None:
    longer = msgspec.structs.replace(CAMERA, fx=1.02 * CAMERA.fx, fy=1.02 * CAMERA.fy)
    found = mend_by_tracks(PosedCameras((longer,) * 24, AROUND.cam_from_object), TRACKS, 200)
    assert found.verdict == "adjusted"
    assert found.posed.cameras[0].fx == pytest.approx(520, rel=2e-3)


def test_a_focal_length_that_is_right_stays_to_the_bit() -> None:
    found = mend_by_tracks(disturbed(AROUND, 0.5, 0.02), TRACKS, 640)
    assert found.posed.cameras == AROUND.cameras


def test_distortion_that_was_left_out_is_found() -> None:
    bent = msgspec.structs.replace(CAMERA, distortion=(-0.2, 0.0, 0.0, 0.0, 0.0))
    truth = PosedCameras((bent,) * 24, AROUND.cam_from_object)
    given = disturbed(AROUND, 0.3, 0.01)
    found = mend_by_tracks(given, shared(truth, 2000), 640)
    assert found.posed.cameras[0].distortion[0] == pytest.approx(-0.2, abs=0.02)
    assert found.posed.cameras[0].fx == pytest.approx(520, rel=0.01)


def test_cameras_of_no_rigid_scene_are_kept() -> None:
    rng = np.random.default_rng(0)
    anywhere = Tracks(TRACKS.track, TRACKS.image, rng.uniform((0, 0), (639, 479), TRACKS.pixels.shape))
    found = mend_by_tracks(AROUND, anywhere, 640)
    assert (found.verdict, found.posed is AROUND) == ("no fit", True)


def test_cameras_do_not_follow_a_background_that_moves_otherwise() -> None:
    still = PosedCameras(AROUND.cameras, cameras_around(CAMERA, 24 * 12).cam_from_object[:24])
    found = mend_by_tracks(AROUND, shared(still, 4000), 640)
    assert (found.verdict, found.posed is AROUND) == ("no fit", True)


def test_too_little_shared_keeps_the_cameras() -> None:
    few = TRACKS.chosen(np.arange(TRACKS.count) < 40)
    found = mend_by_tracks(AROUND, few, 640)
    assert (found.verdict, found.posed is AROUND, found.before_px) == ("too few", True, None)
    assert found.unsupported.all()


def test_photographs_mend_their_cameras() -> None:
    camera = Camera(480, 360, 330.0, 330.0, 239.5, 179.5)
    truth = cameras_before_a_wall(camera, 7)
    images = [photograph(camera, pose) for pose in truth.cam_from_object]
    longer = msgspec.structs.replace(camera, fx=345.0, fy=345.0)
    given = PosedCameras((longer,) * 7, disturbed(truth, 0.5, 0.02).cam_from_object)
    told: list[tuple[str, float]] = []
    found = mend(given, lambda index, width, height: images[index], threads=1, report=lambda *what: told.append(what))
    assert found.verdict == "adjusted"
    turned, moved = worst(aligned(found, truth), truth)
    assert turned < 0.2
    assert moved < 0.01
    assert found.posed.cameras[0].fx == pytest.approx(330, rel=0.01)
    assert [share for what, share in told if what == "matching the images"][-1] == 1.0
    kept = mend(truth, lambda index, width, height: images[index], threads=1)
    assert (kept.verdict, kept.posed) == ("fit", truth)


def test_large_images_are_shrunk_and_their_cameras_are_not() -> None:
    camera = Camera(1600, 1200, 1100.0, 1100.0, 801.3, 590.2)
    truth = cameras_before_a_wall(camera, 5)
    sizes = []

    def load(index: int, width: int, height: int) -> np.ndarray:
        sizes.append((width, height))
        return photograph(camera.resized(width, height), truth.cam_from_object[index])

    found = mend(disturbed(truth, 0.5, 0.02), load, threads=1)
    assert found.verdict == "adjusted"
    assert set(sizes) == {(800, 600)}
    mended = found.posed.cameras[0]
    assert (mended.width, mended.height) == (1600, 1200)
    assert (mended.cx, mended.cy) == pytest.approx((801.3, 590.2), abs=1e-9)
    assert mended.fx == pytest.approx(1100, rel=0.01)


def test_plain_images_tell_nothing() -> None:
    grey = np.full((480, 640, 3), 90, np.uint8)
    found = mend(AROUND, lambda index, width, height: grey, threads=1)
    assert (found.verdict, found.posed is AROUND, found.tracks) == ("too few", True, 0)
