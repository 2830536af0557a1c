from dataclasses import replace

import msgspec
import numpy as np
import pytest
from support.analytic_scene import AnalyticScene, camera, viewpoint

from fieldpose.bus.messages import Reason
from fieldpose.stages.geometry import Camera, exp_se3
from fieldpose.stages.nerf.rendering_api import RenderedView
from fieldpose.stages.rendering.core import RenderingConfig, ViewSource, view_camera

CAMERA = camera(80)
POSE = viewpoint()
CONFIG = RenderingConfig(reuse_angle_deg=2.0, reuse_shift=0.05, next_pass_share=0.2)


class Counting(AnalyticScene):
    """Counts the views that it renders."""

    def __init__(self) -> None:
        super().__init__()
        self.rendered = 0

    def render_view(self, camera: Camera, cam_from_object: np.ndarray) -> RenderedView:
        self.rendered += 1
        return super().render_view(camera, cam_from_object)


@pytest.fixture
def scene() -> Counting:
    return Counting()


def around(azimuth_deg: float) -> np.ndarray:
    return viewpoint(20.0 + azimuth_deg)


def test_a_view_is_the_shrunk_undistorted_camera_at_the_guess(scene: Counting) -> None:
    lens = Camera(640, 480, 600.0, 610.0, 310.0, 250.0, (-0.2, 0.1, 0.0, 0.0, 0.0))
    sourced = ViewSource(scene, replace(CONFIG, size=160)).view(lens, POSE)
    assert sourced.view.camera == Camera(160, 120, 150.0, 152.5, 310.5 / 4 - 0.5, 250.5 / 4 - 0.5)
    assert sourced.view.rgb.shape == (120, 160, 3)
    assert np.array_equal(sourced.view.cam_from_object, POSE)
    assert sourced.visible == pytest.approx((sourced.view.opacity > 0.5).mean())
    assert not sourced.reused


def test_a_small_frame_is_not_enlarged() -> None:
    assert view_camera(CAMERA, 400) == CAMERA


def test_a_guess_near_a_view_gets_that_view_and_its_id(scene: Counting) -> None:
    source = ViewSource(scene, CONFIG)
    first, again = source.view(CAMERA, POSE), source.view(CAMERA, around(0.5))
    assert again.reused
    assert again.view_id == first.view_id
    assert again.view is first.view
    assert scene.rendered == 1


@pytest.mark.parametrize(
    "guess",
    [
        around(4.0),  # seen from another direction
        exp_se3([0, 0, 0, 0, 0.06, 0]) @ POSE,  # turned away
        exp_se3([0, 0, 0, 0, 0, 0.3]) @ POSE,  # rolled
        exp_se3([0, 0, 1.2, 0, 0, 0]) @ POSE,  # from farther away
    ],
)
def test_a_guess_that_looks_different_is_rendered(scene: Counting, guess: np.ndarray) -> None:
    source = ViewSource(scene, CONFIG)
    first, other = source.view(CAMERA, POSE), source.view(CAMERA, guess)
    assert scene.rendered == 2
    assert first.view_id != other.view_id


def test_a_next_pass_asks_for_a_nearer_view(scene: Counting) -> None:
    source = ViewSource(scene, CONFIG)
    source.view(CAMERA, POSE)
    assert source.view(CAMERA, around(0.2), next_pass=True).reused
    assert not source.view(CAMERA, around(0.8), next_pass=True).reused


def test_the_nearest_of_several_views_is_taken(scene: Counting) -> None:
    source = ViewSource(scene, CONFIG)
    near, far = source.view(CAMERA, around(0.0)), source.view(CAMERA, around(2.5))
    assert source.view(CAMERA, around(0.9)).view_id == near.view_id
    assert source.view(CAMERA, around(1.6)).view_id == far.view_id


def test_another_camera_gets_a_view_of_its_own(scene: Counting) -> None:
    source = ViewSource(scene, CONFIG)
    source.view(CAMERA, POSE)
    assert not source.view(msgspec.structs.replace(CAMERA, fx=CAMERA.fx * 1.01), POSE).reused


def test_zero_uses_a_view_again_at_the_very_same_pose_alone(scene: Counting) -> None:
    source = ViewSource(scene, replace(CONFIG, reuse_angle_deg=0.0), "field")
    first, near, again = source.view(CAMERA, POSE), source.view(CAMERA, around(0.01)), source.view(CAMERA, POSE)
    assert scene.rendered == 2
    assert [view.reused for view in (first, near, again)] == [False, False, True]
    assert first.view_id == again.view_id != near.view_id
    assert ViewSource(scene, CONFIG, "other field").view(CAMERA, POSE).view_id != first.view_id


def test_the_cache_forgets_the_longest_unused_views_within_its_bytes(scene: Counting) -> None:
    one_view_mb = 80 * 80 * (3 + 4 + 4) / 2**20
    source = ViewSource(scene, replace(CONFIG, cache_mb=2.5 * one_view_mb))
    for azimuth in (0, 10, 0, 20):  # 10 is the longest unused when 20 comes
        source.view(CAMERA, around(azimuth))
    assert source.view(CAMERA, around(0)).reused
    assert source.view(CAMERA, around(20)).reused
    assert not source.view(CAMERA, around(10)).reused


def test_a_view_of_nothing_says_so_and_is_never_near_another(scene: Counting) -> None:
    source, away = ViewSource(scene, CONFIG), np.diag([1.0, -1.0, -1.0, 1.0]) @ POSE
    assert source.view(CAMERA, away) is Reason.NOTHING_IN_VIEW
    beside = away.copy()
    beside[0, 3] += 1e-3
    assert source.view(CAMERA, beside) is Reason.NOTHING_IN_VIEW
    assert scene.rendered == 2
    assert source.view(CAMERA, away) is Reason.NOTHING_IN_VIEW
    assert scene.rendered == 2
