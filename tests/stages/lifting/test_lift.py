import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.analytic_scene import AnalyticScene, camera, distance_to_surface, viewpoint

from fieldpose.stages.geometry import Camera, camera_centre, inverse, look_at, rays
from fieldpose.stages.lifting.core import LiftingConfig, consistency, depth_at, lift
from fieldpose.stages.nerf.rendering_api import RenderedRays, RenderedView

CAMERA = camera(120)
POSE = viewpoint()
CONFIG = LiftingConfig(min_kept=0)


class Plane:
    """An opaque plane z = 0, and how many rays it was asked for."""

    def __init__(self) -> None:
        self.calls: list[int] = []

    def render_rays(self, origins: np.ndarray, directions: np.ndarray) -> RenderedRays:
        self.calls.append(len(origins))
        depth = (-origins[:, 2] / directions[:, 2]).astype(np.float32)
        ones = np.ones(len(origins), np.float32)
        return RenderedRays(np.ones((len(origins), 3), np.float32), depth, ones)


@pytest.fixture(scope="module")
def scene() -> AnalyticScene:
    return AnalyticScene()


@pytest.fixture(scope="module")
def view(scene: AnalyticScene) -> RenderedView:
    return scene.render_view(CAMERA, POSE)


@settings(max_examples=30, deadline=None)
@given(st.floats(0.3, 2.5), st.floats(0, 360), st.floats(25, 85))
def test_points_of_a_plane_lie_on_it_and_are_consistent(distance: float, azimuth: float, elevation: float) -> None:
    around, above = np.deg2rad([azimuth, elevation])
    eye = distance * np.array([np.cos(around) * np.cos(above), np.sin(around) * np.cos(above), np.sin(above)])
    pose, cam = look_at(eye, (0, 0, 0), (0.01, 0.02, 1)), Camera(60, 40, 150.0, 150.0, 30.0, 19.0)
    plane, pixels = Plane(), np.random.default_rng(0).uniform(1, 38, (50, 2))
    depth = plane.render_rays(*rays(cam, pose)).depth.reshape(40, 60)
    lifted = lift(plane, depth, np.ones_like(depth), cam, pose, pixels, np.random.default_rng(1), CONFIG)
    assert lifted.kept.all()
    assert np.abs(lifted.points_in_object[:, 2]).max() < 1e-3 * distance
    assert lifted.consistency.max() < (1e-3 * distance) ** 2
    back = cam.project(lifted.points_in_object @ pose[:3, :3].T + pose[:3, 3])
    assert np.abs(back - pixels).max() < 0.01


def test_one_call_renders_k_rays_a_point() -> None:
    plane, depth = Plane(), np.full((10, 10), 2.0, np.float32)
    pose, cam = look_at((0, 0, 2), (0, 0, 0), (0, 1, 0)), Camera(10, 10, 20.0, 20.0, 4.5, 4.5)
    pixels = np.random.default_rng(0).uniform(0, 9, (17, 2))
    rng = np.random.default_rng(0)
    lift(plane, depth, np.ones_like(depth), cam, pose, pixels, rng, LiftingConfig(views=5))
    assert plane.calls == [5 * 17]
    lift(plane, depth, np.ones_like(depth), cam, pose, pixels, rng, LiftingConfig(views=0))
    assert plane.calls == [5 * 17]


def test_nearby_views_keep_distance_and_angle() -> None:
    class Recorder(Plane):
        def render_rays(self, origins: np.ndarray, directions: np.ndarray) -> RenderedRays:
            self.origins, self.directions = origins, directions
            return super().render_rays(origins, directions)

    recorder, centre = Recorder(), np.array([0.3, -0.2, 2.0])
    points = np.random.default_rng(0).uniform(-1, 1, (9, 3))
    config = LiftingConfig(views=6, angle_deg=4.0)
    consistency(recorder, points, centre, np.random.default_rng(0), config)
    before = np.repeat(points - centre, 6, axis=0)
    after = recorder.directions
    np.testing.assert_allclose(recorder.origins + after, np.repeat(points, 6, axis=0), atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(after, axis=1), np.linalg.norm(before, axis=1), rtol=1e-5)
    cosine = (before * after).sum(axis=1) / (np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1))
    np.testing.assert_allclose(np.rad2deg(np.arccos(cosine)), 4.0, atol=0.05)
    spread = recorder.origins.reshape(9, 6, 3).mean(axis=1)
    opposite = points - np.cos(np.deg2rad(4.0)) * (points - centre)
    np.testing.assert_allclose(spread, opposite, atol=1e-5)


def test_mining_discards_points_off_the_surface_and_keeps_those_on_it() -> None:
    """Soft silhouettes mix the depths of two surfaces into points on neither."""
    scene = AnalyticScene(softness=0.02)
    view = scene.render_view(CAMERA, POSE)
    pixels = CAMERA.grid()[view.opacity.ravel() > 0.5]
    lifted = lift(scene, view.depth, view.opacity, CAMERA, POSE, pixels, np.random.default_rng(0), CONFIG)
    off = distance_to_surface(lifted.points_in_object)
    wrong, right = off > 0.15, off < 0.02
    assert wrong.sum() > 50
    assert lifted.kept[right].mean() > 0.85
    assert lifted.kept[wrong].mean() < 0.1
    assert np.median(lifted.consistency[wrong]) > 100 * np.median(lifted.consistency[right])


def test_a_point_that_few_views_see_otherwise_is_only_blamed_by_the_mean() -> None:
    """A wall at z = 3, and something in front of it that one nearby view of six has in its way."""

    class Wall:
        def render_rays(self, origins: np.ndarray, directions: np.ndarray) -> RenderedRays:
            depth = ((3.0 - origins[:, 2]) / directions[:, 2]).astype(np.float32)
            depth[::6] *= 0.5
            return RenderedRays(np.zeros((len(depth), 3), np.float32), depth, np.ones_like(depth))

    points = np.array([[0.0, 0.0, 3.0], [0.2, 0.1, 3.0], [-0.3, 0.2, 3.0], [0.1, -0.2, 3.0]])
    for statistic, blamed in (("median", False), ("mean", True)):
        config = LiftingConfig(views=6, statistic=statistic)  # type: ignore[arg-type]
        spread = consistency(Wall(), points, np.zeros(3), np.random.default_rng(0), config)  # type: ignore[arg-type]
        assert ((spread > 0.1) == blamed).all()


def test_a_smaller_gamma_keeps_fewer_and_a_unit_is_absolute(scene: AnalyticScene, view: RenderedView) -> None:
    pixels = CAMERA.grid()[view.opacity.ravel() > 0.5][::7]

    def kept(config: LiftingConfig) -> np.ndarray:
        return lift(scene, view.depth, view.opacity, CAMERA, POSE, pixels, np.random.default_rng(0), config).kept

    loose, tight = kept(LiftingConfig(gamma=8.0)), kept(LiftingConfig(gamma=0.5))
    assert (tight <= loose).all()
    assert 0 < tight.sum() < loose.sum()
    strict = kept(LiftingConfig(gamma=1e-6, enough=0))
    more = int(strict.sum()) + 40
    some = kept(LiftingConfig(gamma=1e-6, enough=more, gamma_most=1e9))
    assert (strict <= some).all()
    assert some.sum() == more
    limited = kept(LiftingConfig(gamma=1e-6, enough=more, gamma_most=1.0))
    np.testing.assert_array_equal(limited, strict)
    absolute = LiftingConfig(gamma=0.02, gamma_unit="field")
    lifted = lift(scene, view.depth, view.opacity, CAMERA, POSE, pixels, np.random.default_rng(0), absolute)
    np.testing.assert_array_equal(lifted.kept, lifted.consistency <= 0.02**2)


def test_pixels_that_show_nothing_are_not_kept(scene: AnalyticScene, view: RenderedView) -> None:
    empty = CAMERA.grid()[view.opacity.ravel() < 0.01][:20]
    lifted = lift(scene, view.depth, view.opacity, CAMERA, POSE, empty, np.random.default_rng(0), CONFIG)
    assert not lifted.kept.any()
    assert np.isfinite(lifted.consistency).all()
    np.testing.assert_allclose(lifted.points_in_object, np.tile(camera_centre(POSE), (20, 1)), atol=1e-5)
    as_bytes = np.rint(view.opacity * 255).astype(np.uint8)
    again = lift(scene, view.depth, as_bytes, CAMERA, POSE, empty, np.random.default_rng(0), CONFIG)
    assert not again.kept.any()


def test_no_pixels_are_no_points(scene: AnalyticScene, view: RenderedView) -> None:
    none = np.zeros((0, 2), np.float32)
    lifted = lift(scene, view.depth, view.opacity, CAMERA, POSE, none, np.random.default_rng(0), CONFIG)
    assert lifted.points_in_object.shape == (0, 3)
    assert lifted.kept.shape == (0,)


def test_depth_is_not_mixed_across_an_edge() -> None:
    depth = np.array([[1.0, 1.01, 5.0], [1.0, 1.01, 5.0], [0.0, 1.0, 5.0]], np.float32)
    pixels = np.array([[0.5, 0.5], [1.4, 0.5], [1.6, 0.5], [0.4, 1.6], [2.3, -0.2]])
    np.testing.assert_allclose(depth_at(depth, pixels, 0.03), [1.005, 1.01, 5.0, 0.0, 5.0], atol=1e-6)


def test_points_are_in_object_coordinates(scene: AnalyticScene, view: RenderedView) -> None:
    """The point of the middle pixel is in front of the camera at its depth."""
    pixel = np.array([[60.0, 70.0]])
    lifted = lift(scene, view.depth, view.opacity, CAMERA, POSE, pixel, np.random.default_rng(0), CONFIG)
    in_cam = np.append(np.linalg.inv(CAMERA.matrix()) @ [60, 70, 1] * view.depth[70, 60], 1)
    np.testing.assert_allclose(lifted.points_in_object[0], (inverse(POSE) @ in_cam)[:3], atol=1e-5)
