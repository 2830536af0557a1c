import numpy as np

from fieldpose.stages.geometry import exp_se3, image_jacobian, look_at, twist_gradient

POSE = look_at((2.5, -2.0, 1.8), (0.0, 0.1, 0.0), (0.0, 0.0, 1.0))
STEP = 1e-6


def test_image_points_move_with_the_left_twist_as_their_jacobian_says() -> None:
    points = np.random.default_rng(0).uniform(-0.8, 0.8, (20, 3))

    def seen(twist: np.ndarray) -> np.ndarray:
        pose = exp_se3(twist) @ POSE
        in_cam = points @ pose[:3, :3].T + pose[:3, 3]
        return np.column_stack([in_cam[:, :2] / in_cam[:, 2:], 1 / in_cam[:, 2]])

    numeric = np.stack([(seen(STEP * axis) - seen(-STEP * axis)) / (2 * STEP) for axis in np.eye(6)], axis=-1)
    np.testing.assert_allclose(image_jacobian(*seen(np.zeros(6)).T), numeric[:, :2], atol=1e-8)


def test_single_precision_stays_single() -> None:
    one = np.ones(3, np.float32)
    assert image_jacobian(one, one, one).dtype == np.float32


def test_a_function_of_rays_changes_with_their_twist_as_its_gradient_says() -> None:
    rng = np.random.default_rng(1)
    origins, directions, by_ray = rng.normal(size=(5, 3)), rng.normal(size=(5, 3)), rng.normal(size=(5, 6))

    def values(twist: np.ndarray) -> np.ndarray:
        motion = exp_se3(twist)
        moved = np.hstack([origins @ motion[:3, :3].T + motion[:3, 3], directions @ motion[:3, :3].T])
        return (moved * by_ray).sum(axis=1)

    numeric = np.stack([(values(STEP * axis) - values(-STEP * axis)) / (2 * STEP) for axis in np.eye(6)], axis=-1)
    np.testing.assert_allclose(twist_gradient(origins, directions, by_ray), numeric, atol=1e-8)
