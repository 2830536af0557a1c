import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.linalg import expm

from fieldpose.errors import GeometryError
from fieldpose.stages.geometry import rigid

number = st.floats(-3, 3, allow_subnormal=False)
vector = st.tuples(number, number, number).map(np.array)


any_angle = st.floats(0, np.pi - 1e-6)


@st.composite
def twists(draw: st.DrawFn, angles: st.SearchStrategy[float] = any_angle) -> np.ndarray:
    axis = draw(vector.filter(lambda v: np.linalg.norm(v) > 1e-3))
    return np.concatenate([draw(vector), draw(angles) * axis / np.linalg.norm(axis)])


transforms = twists().map(rigid.exp_se3)
near_the_edges = st.one_of(
    st.floats(0, 1e-3), st.floats(np.pi - 1e-3, np.pi - 1e-7), st.just(0.0), st.sampled_from([0.99e-4, 1.01e-4])
)


def matrix_of(twist: np.ndarray) -> np.ndarray:
    matrix = np.zeros((4, 4))
    matrix[:3, :3], matrix[:3, 3] = rigid.skew(twist[3:]), twist[:3]
    return matrix


@given(st.one_of(twists(), twists(near_the_edges)))
def test_exp_is_the_matrix_exponential_and_log_its_inverse(twist: np.ndarray) -> None:
    transform = rigid.exp_se3(twist)
    np.testing.assert_allclose(transform, expm(matrix_of(twist)), atol=1e-10)
    np.testing.assert_allclose(rigid.log_se3(transform), twist, atol=1e-7)
    np.testing.assert_allclose(rigid.exp_se3(rigid.log_se3(transform)), transform, atol=1e-10)


@given(twists(st.just(np.pi)))
def test_log_of_half_a_turn_is_one_of_its_two_twists(twist: np.ndarray) -> None:
    transform = rigid.exp_se3(twist)
    back = rigid.log_se3(transform)
    assert np.linalg.norm(back[3:]) == pytest.approx(np.pi)
    np.testing.assert_allclose(rigid.exp_se3(back), transform, atol=1e-10)


@given(transforms, transforms, transforms)
def test_rigid_transforms_are_a_group(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> None:
    np.testing.assert_allclose((a @ b) @ c, a @ (b @ c), atol=1e-10)
    np.testing.assert_allclose(a @ rigid.inverse(a), np.eye(4), atol=1e-12)
    np.testing.assert_allclose(rigid.inverse(a @ b), rigid.inverse(b) @ rigid.inverse(a), atol=1e-10)
    assert rigid.is_rigid(a @ b @ c)


@given(transforms, twists(), transforms)
def test_adjoint_moves_a_twist_through_a_transform(a: np.ndarray, twist: np.ndarray, b: np.ndarray) -> None:
    moved = rigid.exp_se3(rigid.adjoint(a) @ twist)
    np.testing.assert_allclose(a @ rigid.exp_se3(twist) @ rigid.inverse(a), moved, atol=1e-9)
    np.testing.assert_allclose(rigid.adjoint(a @ b), rigid.adjoint(a) @ rigid.adjoint(b), atol=1e-9)


@given(transforms, transforms, st.floats(0, 1))
def test_interpolate_runs_from_start_to_end_at_constant_speed(a: np.ndarray, b: np.ndarray, alpha: float) -> None:
    np.testing.assert_allclose(rigid.interpolate(a, b, 0), a, atol=1e-9)
    np.testing.assert_allclose(rigid.interpolate(a, b, 1), b, atol=1e-7)
    step = rigid.log_se3(rigid.interpolate(a, b, alpha) @ rigid.inverse(a))
    np.testing.assert_allclose(step, alpha * rigid.log_se3(b @ rigid.inverse(a)), atol=1e-6)


@given(transforms, st.lists(st.floats(-0.05, 0.05), min_size=9, max_size=9))
def test_nearest_rigid_mends_noise_and_keeps_what_is_rigid(transform: np.ndarray, noise: list[float]) -> None:
    np.testing.assert_allclose(rigid.nearest_rigid(transform), transform, atol=1e-12)
    noisy = transform.copy()
    noisy[:3, :3] += np.reshape(noise, (3, 3))
    mended = rigid.nearest_rigid(noisy)
    assert rigid.is_rigid(mended, 1e-9)
    distance = np.linalg.norm(mended[:3, :3] - noisy[:3, :3])
    assert distance <= np.linalg.norm(transform[:3, :3] - noisy[:3, :3]) + 1e-9


def test_nearest_rigid_of_a_reflection_is_a_rotation() -> None:
    assert rigid.is_rigid(rigid.nearest_rigid(np.diag([1.0, 1.0, -1.0, 1.0])))


@pytest.mark.parametrize(
    "matrix",
    [
        np.diag([2.0, 2.0, 2.0, 1.0]),
        np.diag([1.0, 1.0, -1.0, 1.0]),
        np.diag([1.0, 1.0, 1.0, 2.0]),
        np.full((4, 4), np.nan),
        np.eye(3),
        np.eye(4) + 0.01 * np.eye(4, k=1),
    ],
)
def test_what_is_not_rigid_is_told(matrix: np.ndarray) -> None:
    assert rigid.is_rigid(np.eye(4))
    assert not rigid.is_rigid(matrix)


@given(vector, vector, vector)
@example(np.zeros(3), np.array([0.0, 0.0, 1.0]), np.array([0.0, -1.0, 0.0]))
def test_look_at_puts_the_target_ahead_and_up_upwards(eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> None:
    forward = target - eye
    if np.linalg.norm(np.cross(forward, up)) < 1e-3:
        return
    cam_from_object = rigid.look_at(eye, target, up)
    assert rigid.is_rigid(cam_from_object, 1e-9)
    np.testing.assert_allclose(rigid.camera_centre(cam_from_object), eye, atol=1e-9)
    np.testing.assert_allclose((cam_from_object @ [*target, 1])[:3], [0, 0, np.linalg.norm(forward)], atol=1e-9)
    up_in_cam = cam_from_object[:3, :3] @ up
    assert abs(up_in_cam[0]) < 1e-9
    assert up_in_cam[1] < 0


def test_look_at_refuses_what_fixes_no_pose() -> None:
    with pytest.raises(GeometryError, match="viewing direction"):
        rigid.look_at((1, 2, 3), (1, 2, 3), (0, 0, 1))
    with pytest.raises(GeometryError, match="up of look_at"):
        rigid.look_at((0, 0, 0), (0, 0, 2), (0, 0, 1))


def test_rotation_about_turns_by_the_right_hand() -> None:
    turned = rigid.rotation_about((0, 0, 5), np.pi / 2) @ [1, 0, 0, 1]
    np.testing.assert_allclose(turned, [0, 1, 0, 1], atol=1e-12)
    with pytest.raises(GeometryError, match="axis"):
        rigid.rotation_about((0, 0, 0), 1.0)
