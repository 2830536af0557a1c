"""Boards in images, and the lens that their corners tell."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from support.boards import Fisheye, Pinhole, charuco, chess, photograph, poses

from fieldpose.errors import GeometryError
from fieldpose.stages.camera.boards import Board, Finder, View, drawn, seen_instead
from fieldpose.stages.camera.lenses import FEWEST_VIEWS, covered, descriptor, diverse, fit_lens, unseen
from fieldpose.stages.geometry import Camera

CAMERA = Camera(640, 480, 520.0, 523.0, 325.0, 236.0, (-0.2, 0.08, 0.001, -0.0008, 0.0))
CHARUCO, CHESS = Board("charuco", 7, 5), Board("chess", 7, 5)
PLACES = np.pad(CHARUCO.corners(), ((0, 0), (0, 1)))
NOISE_PX = 0.06


def grey(sheet: np.ndarray, pose: np.ndarray, seed: int = 0) -> np.ndarray:
    return photograph(sheet, Pinhole(CAMERA), pose, seed=seed)[..., 0]


def at(camera: Camera, pose: np.ndarray) -> np.ndarray:
    return camera.project(PLACES @ pose[:3, :3].T + pose[:3, 3])


def views(count: int, camera: Camera = CAMERA, seed: int = 0, **where: float) -> list[View]:
    """Corners as they are found, without images."""
    shaken, found = np.random.default_rng(seed + 1000), []
    for pose in poses(count, seed, **({"near": 5.0, "reach": 0.4} | where)):
        pixels = at(camera, pose)
        inside = ((pixels > 8) & (pixels < np.array([camera.width, camera.height]) - 9)).all(axis=1)
        if inside.sum() >= 8:
            seen = pixels[inside]
            found.append(View(np.flatnonzero(inside), seen + shaken.normal(0, NOISE_PX, seen.shape)))
    return found


@pytest.mark.parametrize(("board", "sheet"), [(CHARUCO, charuco()), (CHESS, chess())])
def test_corners_are_found_where_they_are(board: Board, sheet: np.ndarray) -> None:
    finder, count = Finder(board), 0
    for i, pose in enumerate(poses(6, near=6.0, reach=0.2)):
        view = finder(grey(sheet, pose, i))
        if view is None:
            continue
        # A chessboard without markers is as well the other way round.
        there = min(
            (at(CAMERA, pose)[view.ids], at(CAMERA, pose)[::-1][view.ids]), key=lambda p: np.ptp(p - view.pixels)
        )
        apart = view.pixels - there
        assert np.median(np.linalg.norm(apart, axis=1)) < 0.1
        assert np.abs(np.median(apart, axis=0)).max() < 0.05
        count += 1
    assert count >= 5
    assert finder(np.full((480, 640), 128, np.uint8)) is None


def test_a_board_is_drawn_as_opencv_has_it() -> None:
    for across, down in ((7, 5), (6, 4), (5, 8)):
        board = Board("charuco", across, down)
        ours = cv2.resize(drawn(board, 96), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        theirs = cv2.resize(charuco(across, down)[96:-96, 96:-96], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        assert np.mean(ours != theirs) < 0.001
    np.testing.assert_array_equal(drawn(CHESS, 96), chess()[96:-96, 96:-96])


@pytest.mark.parametrize(
    ("board", "sheet", "said"),
    [
        (CHARUCO, charuco(), None),
        (CHESS, chess(), None),
        (Board("charuco", 8, 6), charuco(), "a board of 7x5 squares; give --squares 7x5"),
        (Board("charuco", 5, 7), charuco(), "a board of 7x5 squares"),
        (Board("charuco", 7, 4), charuco(), "a board of 7x5 squares"),
        (Board("charuco", 7, 5, marker=0.6), charuco(), "markers of 0.7"),
        (Board("charuco", 7, 5, family="5x5"), charuco(), "markers of family 4x4 in one image; give --family 4x4"),
        (CHARUCO, chess(), "a chessboard of 7x5 squares (6x4 inner corners); give --board chess --squares 7x5"),
        (Board("chess", 6, 4), chess(), "a chessboard of 7x5 squares (6x4 inner corners); give --squares 7x5"),
    ],
)
def test_another_board_is_named(board: Board, sheet: np.ndarray, said: str | None) -> None:
    images = [grey(sheet, pose) for pose in poses(2, near=7.0, reach=0.1, tilt_deg=15)]
    found = seen_instead(board, images)
    assert (found is None) if said is None else (found is not None and said in found)


def test_boards_of_older_opencv_are_named() -> None:
    aruco = cv2.aruco
    old = aruco.CharucoBoard((7, 6), 1.0, 0.75, aruco.getPredefinedDictionary(aruco.DICT_4X4_1000))
    old.setLegacyPattern(True)
    image = cv2.copyMakeBorder(old.generateImage((420, 360)), 50, 50, 50, 50, cv2.BORDER_CONSTANT, value=255)
    found = seen_instead(Board("charuco", 7, 6), [image])
    assert found is not None
    assert "first square is white, as OpenCV drew them before 4.6" in found


@pytest.mark.parametrize("values", [{"across": 2}, {"down": 99}, {"marker": 1.0}, {"across": 9, "family": "tag16h5"}])
def test_what_makes_no_board(values: dict[str, object]) -> None:
    with pytest.raises(GeometryError):
        Board(**({"kind": "charuco", "across": 7, "down": 8} | values))  # type: ignore[arg-type]


def test_the_lens_and_its_deviation_are_right() -> None:
    off = []
    for seed in range(12):
        lens = fit_lens(CHARUCO, views(25, seed=seed), 640, 480)
        assert lens.terms == "k1 k2 p1 p2"
        assert lens.error_px == pytest.approx(NOISE_PX * np.sqrt(2), rel=0.25)
        off.append((lens.camera.fx - CAMERA.fx) / lens.focal_sd_px)
    assert 0.5 < np.sqrt(np.mean(np.square(off))) < 1.7


@pytest.mark.parametrize(
    ("distortion", "terms"),
    [((0.0,) * 5, "none"), ((-0.1, 0, 0, 0, 0), "k1"), ((-0.3, 0.1, 0, 0, 0.05), "k1 k2 p1 p2 k3")],
)
def test_as_many_coefficients_as_the_views_speak_for(distortion: tuple[float, ...], terms: str) -> None:
    camera = Camera(640, 480, 520.0, 520.0, 319.5, 239.5, distortion)  # type: ignore[arg-type]
    assert fit_lens(CHARUCO, views(30, camera), 640, 480).terms == terms


def test_images_of_twice_the_size_have_twice_the_focal_length() -> None:
    seen = views(20)
    twice = [View(view.ids, (view.pixels + 0.5) * 2 - 0.5) for view in seen]
    small, large = fit_lens(CHARUCO, seen, 640, 480), fit_lens(CHARUCO, twice, 1280, 960)
    found, expected = large.camera, small.camera.resized(1280, 960)
    np.testing.assert_allclose(
        (found.fx, found.fy, found.cx, found.cy), (expected.fx, expected.fy, expected.cx, expected.cy), rtol=1e-5
    )
    np.testing.assert_allclose(found.distortion, expected.distortion, atol=1e-4)
    assert large.focal_sd_px == pytest.approx(2 * small.focal_sd_px, rel=1e-3)


def test_views_that_do_not_agree_are_dropped() -> None:
    seen = views(20)
    wrong = {3, 11}
    for i in wrong:
        seen[i] = View(seen[i].ids, seen[i].pixels + np.random.default_rng(i).normal(0, 4, seen[i].pixels.shape))
    lens = fit_lens(CHARUCO, seen, 640, 480)
    assert set(range(20)) - set(lens.used) == wrong
    assert lens.camera.fx == pytest.approx(CAMERA.fx, rel=0.002)


def test_what_leaves_the_camera_open_is_refused() -> None:
    with pytest.raises(GeometryError, match=f"7 views show the board, but at least {FEWEST_VIEWS} are needed"):
        fit_lens(CHARUCO, views(7), 640, 480)
    for tilt in (0.0, 1.5):
        with pytest.raises(GeometryError, match=r"leave the focal length open.*tilted by 30"):
            fit_lens(CHARUCO, views(25, tilt_deg=tilt), 640, 480)
    shaken = np.random.default_rng(0)
    rough = [View(v.ids, v.pixels + shaken.normal(0, 2.0, v.pixels.shape)) for v in views(10, tilt_deg=12.0, near=9.0)]
    with pytest.raises(GeometryError, match="leave the focal length open"):
        fit_lens(CHARUCO, rough, 640, 480)


def test_a_fisheye_is_refused_and_a_bent_board_too() -> None:
    lens, finder = Fisheye((640, 480), 270.0), Finder(CHARUCO)
    images = [
        photograph(charuco(), lens, pose, seed=i)[..., 0] for i, pose in enumerate(poses(36, reach=1.0, near=3.0))
    ]
    seen = [view for view in map(finder, images) if view is not None]
    with pytest.raises(GeometryError, match=r"a fisheye lens, which is not supported .*linear mode"):
        fit_lens(CHARUCO, seen, 640, 480)
    stretched = [View(v.ids, v.pixels + 25 * np.sin(3.0 * v.ids[:, None] + i)) for i, v in enumerate(views(20))]
    with pytest.raises(GeometryError, match=r"no lens fits \(the best is .* is the board flat"):
        fit_lens(CHARUCO, stretched, 640, 480)


def test_views_are_chosen_that_differ_and_parts_that_were_not_seen_named() -> None:
    near, far = views(12, seed=1), views(3, seed=2, near=12.0, reach=0.3)
    every = near[:1] * 20 + near + far
    likeness = np.stack([descriptor(CHARUCO, view, 640, 480) for view in every])
    taken = diverse(likeness, np.ones(len(every)), 14)
    assert len(taken) == 14
    assert sum(i < 20 for i in taken) <= 1
    assert set(range(32, 35)) <= set(taken)
    left = [View(v.ids, np.stack([v.pixels[:, 0] * 0.45, v.pixels[:, 1]], axis=1)) for v in near]
    mask = covered(left, 640, 480)
    assert mask.mean() < 0.5
    assert {"top right", "right", "bottom right"} <= set(unseen(mask))
    assert "left" not in unseen(mask)
