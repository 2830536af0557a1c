"""What a plain background contradicts, on a scene whose geometry is known exactly."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.analytic_scene import AnalyticScene, camera, viewpoint

from fieldpose.stages.geometry import Camera, exp_se3, rays
from fieldpose.stages.pnp import constants
from fieldpose.stages.pnp.aligner import Pictures
from fieldpose.stages.pnp.background import Contradiction, PlainBackground

WHITE = 250
TRUTH = viewpoint(25.0, 38.0)
LENS = camera(260, (-0.1, 0.02, 0.001, -0.001, 0.0))


def studio(pose: np.ndarray, lens: Camera) -> np.ndarray:
    """The scene before a white wall, a little noise in it."""
    shown = AnalyticScene().render_rays(*rays(lens, pose))
    rgb = (shown.rgb * shown.opacity[:, None] * 255 + (1 - shown.opacity[:, None]) * WHITE).reshape(
        lens.height, lens.width, 3
    )
    noise = np.random.default_rng(0).integers(-4, 5, rgb.shape)
    return np.clip(np.rint(rgb) + noise, 0, 255).astype(np.uint8)


def pictures(frame: np.ndarray) -> Pictures:
    view = AnalyticScene().render_view(camera(200), viewpoint(40.0, 30.0))
    return Pictures(view.rgb, view.depth, view.camera, view.cam_from_object, frame)


@pytest.fixture(scope="module")
def frame() -> np.ndarray:
    return studio(TRUTH, LENS)


def test_the_background_is_what_hangs_together_with_the_border(frame: np.ndarray) -> None:
    holed = frame.copy()
    shown = AnalyticScene().render_rays(*rays(LENS, TRUTH)).opacity.reshape(260, 260) > 0.5
    y, x = (int(c.mean()) for c in np.nonzero(shown))
    holed[y - 8 : y + 8, x - 8 : x + 8] = WHITE
    found = PlainBackground.of(holed, LENS, 260)
    assert found is not None
    assert np.abs(found.colour - WHITE).max() <= 1
    assert not found.sure[shown].any()
    assert found.sure[~shown].mean() > 0.9


@pytest.mark.parametrize("longer_side", [260, 130])
def test_a_pose_that_puts_the_object_on_the_background_is_contradicted(frame: np.ndarray, longer_side: int) -> None:
    found = PlainBackground.of(frame, LENS, longer_side)
    assert found is not None
    points = _surface()
    assert found.share_on_it(points, TRUTH) < 0.1 * constants.CONTRADICTED
    assert found.share_unexplained(points, TRUTH) < 0.5 * constants.CONTRADICTED
    assert found.share_on_it(points, exp_se3(np.array([0, 0, -1.6, 0, 0, 0.0])) @ TRUTH) > constants.OFF_IT
    for twist in ([0.4, 0, 0, 0, 0, 0], [0, -0.4, 0, 0, 0, 0], [0.0, 0, 0, 0, 0, 0.5]):
        assert found.share_on_it(points, exp_se3(np.array(twist)) @ TRUTH) > 2 * constants.CONTRADICTED, twist
        assert found.share_unexplained(points, exp_se3(np.array(twist)) @ TRUTH) > 2 * constants.CONTRADICTED, twist


def _surface() -> np.ndarray:
    view = AnalyticScene().render_view(camera(200), TRUTH)
    pixels = np.argwhere(view.opacity > 0.99)[:, ::-1][::7]
    origins, directions = rays(view.camera, TRUTH, pixels.astype(np.float32))
    return origins + view.depth[pixels[:, 1], pixels[:, 0], None] * directions


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_the_share_is_that_of_points_looked_up_one_by_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    lens = Camera(40, 30, 35.0, 36.0, 19.0, 15.0, (-0.2, 0.05, 0.0, 0.0, 0.0))
    background = PlainBackground(rng.random((30, 40)) < 0.5, rng.random((30, 40)) < 0.3, lens, np.zeros(3, int))
    points = rng.normal(0, 1, (60, 3))
    pose = exp_se3(np.concatenate([rng.normal(0, 0.5, 3), rng.normal(0, 0.5, 3)])) @ viewpoint(distance=2.0)
    on_it, far = [], background.other.copy()
    for point in points:
        in_cam = pose[:3, :3] @ point + pose[:3, 3]
        if in_cam[2] > 0:
            x, y = lens.project(in_cam[None])[0]
            if -0.5 <= x < 39.5 and -0.5 <= y < 29.5:
                on_it.append(background.sure[round(y), round(x)])
                rows, columns = np.ogrid[:30, :40]
                far &= np.maximum(abs(rows - round(y)), abs(columns - round(x))) > constants.EXPLAINS_PX
    assert background.share_on_it(points, pose) == pytest.approx(np.mean(on_it) if on_it else 0.0)
    assert background.share_unexplained(points, pose) == pytest.approx(far.sum() / background.other.sum())


def test_what_hides_the_object_contradicts_nothing(frame: np.ndarray) -> None:
    hidden = frame.copy()
    hidden[120:, :] = (40, 90, 60)
    hidden[:4] = hidden[-4:] = hidden[:, :4] = hidden[:, -4:] = WHITE
    contradicted = Contradiction(pictures(hidden), LENS)
    assert not contradicted(TRUTH)
    assert Contradiction(pictures(frame), LENS)(exp_se3(np.array([0.4, 0, 0, 0, 0, 0])) @ TRUTH)


def test_no_background_that_is_not_plain_contradicts_anything(frame: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    sloped = np.clip(frame * np.linspace(0.3, 1, 260)[:, None, None], 0, 255).astype(np.uint8)
    shelf = np.where(frame > 235, rng.integers(0, 256, frame.shape), frame).astype(np.uint8)
    away = exp_se3(np.array([0.6, 0, 0, 0, 0, 0])) @ TRUTH
    for image in (sloped, shelf):
        assert PlainBackground.of(image, LENS, 260) is None
        assert not Contradiction(pictures(image), LENS)(away)


def test_an_object_of_the_backgrounds_colour_contradicts_nothing(frame: np.ndarray) -> None:
    given_ = pictures(frame)
    alike = Pictures(np.full_like(given_.view, WHITE - 30), given_.depth, given_.camera, given_.cam_from_object, frame)
    assert not Contradiction(alike, LENS)(exp_se3(np.array([0.6, 0, 0, 0, 0, 0])) @ TRUTH)
