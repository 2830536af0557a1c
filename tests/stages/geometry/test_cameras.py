import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldpose.errors import GeometryError
from fieldpose.stages.geometry import (
    Camera,
    exp_se3,
    look_at,
    points_at_depth,
    rays,
    scale_pixels,
    shrunk_size,
    unscale_pixels,
)  # fmt: skip
from fieldpose.stages.geometry.cameras import distort

# The phone camera of instant-ngp's fox, and one with every coefficient at work.
PHONE = Camera(1080, 1920, 1375.52, 1374.49, 554.058, 964.768, (0.0578421, -0.0805099, -0.000980296, 0.00015575, 0.0))
BARREL = Camera(640, 480, 420.0, 415.0, 322.0, 236.0, (-0.25, 0.09, 0.002, -0.0015, -0.012))


@st.composite
def cameras(draw: st.DrawFn) -> Camera:
    width, height = draw(st.integers(16, 2000)), draw(st.integers(16, 2000))
    focal = draw(st.floats(1, 3)) * max(width, height)
    shift = st.floats(-0.1, 0.1)
    small = st.floats(-0.002, 0.002)
    distortion = (draw(st.floats(-0.15, 0.2)), draw(st.floats(0, 0.1)), draw(small), draw(small), draw(small))
    cx, cy = (0.5 + draw(shift)) * width, (0.5 + draw(shift)) * height
    return Camera(width, height, focal, focal * draw(st.floats(0.95, 1.05)), cx, cy, distortion)


def corners(camera: Camera) -> np.ndarray:
    right, bottom = camera.width - 0.5, camera.height - 0.5
    inside = (0.5 * camera.width - 0.5, 0.3 * camera.height - 0.5)
    return np.array([(-0.5, -0.5), (right, -0.5), (-0.5, bottom), (right, bottom), inside])


@pytest.mark.parametrize("camera", [PHONE, BARREL, PHONE.undistorted()])
def test_directions_and_project_are_inverse_at_every_pixel(camera: Camera) -> None:
    camera = camera.shrunk(max(camera.width, camera.height) // 4)
    directions = camera.directions(camera.grid())
    assert directions.dtype == np.float32
    assert np.all(directions[:, 2] == 1)
    assert np.abs(camera.project(directions) - camera.grid()).max() < 1e-3


@given(cameras(), st.floats(0.1, 50))
def test_directions_and_project_are_inverse_at_the_corners(camera: Camera, depth: float) -> None:
    back = camera.project(depth * camera.directions(corners(camera)).astype(np.float64))
    assert np.abs(back - corners(camera)).max() < 1e-3


@pytest.mark.parametrize("camera", [PHONE, BARREL])
def test_project_is_opencvs(camera: Camera) -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform((-0.5, -0.5, 1), (0.5, 0.5, 3), (100, 3))
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.matrix(), np.array(camera.distortion))[0]
    np.testing.assert_allclose(camera.project(points), expected[:, 0], atol=1e-9)


def test_the_derivative_of_the_distortion() -> None:
    points = np.random.default_rng(1).uniform(-0.6, 0.6, (50, 2))
    _, jacobian = distort(points, BARREL.distortion)
    for axis in range(2):
        step = 1e-6 * np.eye(2)[axis]
        ahead, behind = distort(points + step, BARREL.distortion)[0], distort(points - step, BARREL.distortion)[0]
        np.testing.assert_allclose(jacobian[:, :, axis], (ahead - behind) / 2e-6, atol=1e-8)


def test_points_behind_the_camera_have_no_pixel() -> None:
    pixels = PHONE.project(np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    assert np.isnan(pixels[:2]).all()
    np.testing.assert_allclose(pixels[2], (PHONE.cx, PHONE.cy))


def test_a_distortion_that_folds_the_image_is_refused() -> None:
    folding = Camera(640, 480, 300.0, 300.0, 320.0, 240.0, (-0.5, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(GeometryError, match=r"no inverse at pixel \(0\.0, 0\.0\)"):
        folding.directions(np.array([[320.0, 240.0], [0.0, 0.0]]))


def test_pixels_without_an_inverse_are_told_from_those_with_one() -> None:
    folding = Camera(640, 480, 300.0, 300.0, 320.0, 240.0, (-0.5, 0.0, 0.0, 0.0, 0.0))
    pixels = np.array([[320.0, 240.0], [0.0, 0.0], [400.0, 300.0]])
    ideal, usable = folding.without_distortion(pixels)
    assert usable.tolist() == [True, False, True]
    plain = folding.undistorted().directions(ideal[usable])
    np.testing.assert_allclose(plain, folding.directions(pixels[usable]), atol=1e-6)


@given(cameras(), st.integers(0, 2**32 - 1))
def test_points_at_a_depth_are_seen_there_and_at_their_pixels(camera: Camera, seed: int) -> None:
    rng = np.random.default_rng(seed)
    pose, pixels = exp_se3(rng.normal(0, 1, 6)), rng.uniform(0.3, 0.6, (20, 2)) * (camera.width, camera.height)
    depths = rng.uniform(0.5, 4, 20)
    in_cam = points_at_depth(camera, pose, pixels, depths) @ pose[:3, :3].T + pose[:3, 3]
    np.testing.assert_allclose(in_cam[:, 2], depths, rtol=1e-4)
    np.testing.assert_allclose(camera.project(in_cam), pixels, atol=0.02)


@given(cameras(), st.integers(0, 2**32 - 1))
def test_without_distortion_undoes_it(camera: Camera, seed: int) -> None:
    ideal = np.random.default_rng(seed).uniform(-0.2, 0.2, (20, 2))
    points = np.concatenate([ideal, np.ones((20, 1))], axis=1)
    found, usable = camera.without_distortion(camera.project(points))
    assert usable.all()
    np.testing.assert_allclose(found, camera.undistorted().project(points), atol=1e-3)


@pytest.mark.parametrize(
    ("k1", "k2", "radius"), [(-0.5, 0.0, 0.56), (-0.5, 0.0, 0.7), (-0.5, 0.0, 1.5), (1.0, -0.5, 1.67)]
)
def test_solutions_beyond_the_fold_are_none(k1: float, k2: float, radius: float) -> None:
    """Mirrored (radial factor below zero) and folded (derivative below zero) ones."""
    camera = Camera(640, 480, 300.0, 300.0, 320.0, 240.0, (k1, k2, 0.0, 0.0, 0.0))
    with pytest.raises(GeometryError, match="no inverse"):
        camera.directions(np.array([[320.0 + 300 * radius, 240.0]]))


@given(cameras(), st.integers(8, 1000), st.integers(8, 1000))
def test_resizing_keeps_the_rays_through_the_image(camera: Camera, width: int, height: int) -> None:
    small = camera.resized(width, height)
    assert (small.width, small.height) == (width, height)
    np.testing.assert_allclose(small.directions(corners(small)), camera.directions(corners(camera)), atol=1e-5)
    back = small.resized(camera.width, camera.height)
    np.testing.assert_allclose(back.matrix(), camera.matrix(), rtol=1e-9, atol=1e-9)


def test_resizing_agrees_with_area_averaging() -> None:
    image = np.zeros((60, 80), np.float32)
    image[20:24, 40:44] = 1
    x, y = np.meshgrid(np.arange(80), np.arange(60))
    camera = Camera(80, 60, 100.0, 100.0, float((image * x).sum() / 16), float((image * y).sum() / 16))
    small = cv2.resize(image, (20, 15), interpolation=cv2.INTER_AREA)
    x, y = np.meshgrid(np.arange(20), np.arange(15))
    quarter = camera.shrunk(20)
    assert (quarter.cx, quarter.cy) == pytest.approx(((small * x).sum() / small.sum(), (small * y).sum() / small.sum()))


@given(st.integers(1, 5000), st.integers(1, 5000), st.integers(1, 5000))
def test_a_shrunk_size_is_no_larger_than_asked_for_and_of_the_same_shape(width: int, height: int, most: int) -> None:
    small = shrunk_size(width, height, most)
    assert max(small) == min(most, max(width, height))
    factor = max(small) / max(width, height)
    assert small == pytest.approx(np.maximum((width * factor, height * factor), 1), abs=0.5)


def test_a_camera_is_shrunk_but_never_enlarged() -> None:
    assert BARREL.shrunk(max(BARREL.width, BARREL.height)) is BARREL
    assert BARREL.shrunk(10_000) is BARREL
    assert BARREL.shrunk(100) == BARREL.resized(*shrunk_size(BARREL.width, BARREL.height, 100))


def test_pixels_are_scaled_about_the_corner_of_the_image() -> None:
    scale = np.array([0.5, 0.25])
    borders = np.array([[-0.5, -0.5], [79.5, 59.5], [10.0, 3.0]])
    scaled = scale_pixels(borders, scale)
    np.testing.assert_array_equal(scaled, [[-0.5, -0.5], [39.5, 14.5], [4.75, 0.375]])
    np.testing.assert_array_equal(unscale_pixels(scaled, scale), borders)


def test_grid_runs_along_the_rows() -> None:
    grid = Camera(3, 2, 1.0, 1.0, 1.0, 0.5).grid()
    assert grid.tolist() == [[0, 0], [1, 0], [2, 0], [0, 1], [1, 1], [2, 1]]


@given(cameras(), st.floats(0.1, 20))
def test_rays_pass_through_the_projected_point_at_its_depth(camera: Camera, depth: float) -> None:
    cam_from_object = look_at((1.0, -2.0, 0.7), (0.1, 0.2, -0.3), (0, 0, 1))
    origins, directions = rays(camera, cam_from_object, corners(camera))
    assert origins.dtype == directions.dtype == np.float32
    points = origins.astype(np.float64) + depth * directions
    in_cam = points @ cam_from_object[:3, :3].T + cam_from_object[:3, 3]
    np.testing.assert_allclose(in_cam[:, 2], depth, rtol=1e-4, atol=1e-5)
    assert np.abs(camera.project(in_cam) - corners(camera)).max() < 1e-2 * max(1.0, camera.fx / 1000) / min(depth, 1)


def test_rays_of_all_pixels_follow_the_grid() -> None:
    camera = BARREL.shrunk(32)
    _, everywhere = rays(camera, np.eye(4))
    np.testing.assert_array_equal(everywhere, camera.directions(camera.grid()))


@pytest.mark.parametrize(
    "wrong",
    [
        {"fx": 0.0},
        {"fy": float("nan")},
        {"width": 0},
        {"cx": float("inf")},
        {"distortion": (0.1, 0.2)},
        {"distortion": (float("nan"), 0.0, 0.0, 0.0, 0.0)},
    ],
)
def test_numbers_that_make_no_camera_are_refused(wrong: dict) -> None:
    right = {"width": 4, "height": 3, "fx": 5.0, "fy": 5.0, "cx": 1.5, "cy": 1.0}
    assert not Camera(**right).is_distorted
    with pytest.raises(GeometryError, match="a camera needs"):
        Camera(**(right | wrong))
