"""Two ways down the photometric loss on SE(3), by left increments of the pose.

Sources: Levenberg (1944) and Marquardt (1963); Kingma and Ba, Adam (2015), which the paper uses.
"""

from __future__ import annotations

import numpy as np

from fieldpose.stages.geometry import exp_se3
from fieldpose.stages.refinement import constants
from fieldpose.stages.refinement.config import RefinementConfig
from fieldpose.stages.refinement.photometric import Photometric, PixelSample

_DAMPING, _LESS, _MORE, _MOST = 1e-3, 0.3, 10.0, 1e4
_LITTLE_GAIN = 1e-4
_POOL = 8
_BETA1, _BETA2, _EPSILON = 0.9, 0.99, 1e-12


def levenberg_marquardt(
    photometric: Photometric,
    pool: PixelSample,
    cam_from_object: np.ndarray,
    distance: float,
    rng: np.random.Generator,
    config: RefinementConfig,
) -> tuple[np.ndarray, int]:
    """Damped Gauss-Newton steps on the first pixels of the pool. Returns the pose and the number of steps.

    `distance` is that of the surface from the camera; the pool is in random order.
    """
    sample = _prepared(photometric, pool.part(slice(config.samples)), cam_from_object, config)
    pose, damping, steps = cam_from_object, _DAMPING, 0
    here = photometric.linearise(sample, pose)
    unit = np.array([distance] * 3 + [1.0] * 3)
    for steps in range(1, config.steps + 1):  # noqa: B007
        # Solved in units of the distance and radians, so that the damping treats both alike.
        hessian = here.hessian * np.outer(unit, unit)
        hessian += damping * np.diag(np.diag(hessian)) + 1e-12 * np.eye(6)
        twist = -unit * np.linalg.solve(hessian, unit * here.gradient)
        moved = exp_se3(twist) @ pose
        there = photometric.linearise(sample, moved)
        gain = 1 - there.loss / max(here.loss, 1e-12)
        if gain > 0:
            pose, here, damping = moved, there, damping * _LESS
        else:
            damping *= _MORE
        if np.linalg.norm(twist / unit) < constants.CONVERGED or 0 < gain < _LITTLE_GAIN or damping > _MOST:
            break
    return pose, steps


def adam(
    photometric: Photometric,
    pool: PixelSample,
    cam_from_object: np.ndarray,
    distance: float,
    rng: np.random.Generator,
    config: RefinementConfig,
) -> tuple[np.ndarray, int]:
    """Adam with a new sample in each step and a learning rate that falls to a tenth; see levenberg_marquardt.

    Its variables turn the camera about the surface, not about itself: there, turning and shifting look different.
    """
    pool = _prepared(photometric, pool.part(slice(_POOL * config.samples)), cam_from_object, config)
    pivot = _twist_from_pivot(distance)
    first, second, pose, count = np.zeros(6), np.zeros(6), cam_from_object, len(pool.weights)
    for step in range(1, config.steps + 1):
        chosen = rng.choice(count, min(config.samples, count), replace=False)
        gradient = pivot.T @ photometric.linearise(pool.part(chosen), pose).gradient
        first = _BETA1 * first + (1 - _BETA1) * gradient
        second = _BETA2 * second + (1 - _BETA2) * gradient**2
        direction = first / (1 - _BETA1**step) / (np.sqrt(second / (1 - _BETA2**step)) + _EPSILON)
        rate = constants.LEARNING_RATE * 0.1 ** (step / config.steps)
        pose = exp_se3(pivot @ (-rate * direction)) @ pose
    return pose, config.steps


def _twist_from_pivot(distance: float) -> np.ndarray:
    """Left twist (6,) of (shift in distances, turn about the point at `distance` on the optical axis)."""
    matrix = np.diag([distance] * 3 + [1.0] * 3)
    matrix[0, 4], matrix[1, 3] = -distance, distance
    return matrix


def _prepared(
    photometric: Photometric, sample: PixelSample, cam_from_object: np.ndarray, config: RefinementConfig
) -> PixelSample:
    if config.background == "compare":
        return sample
    return photometric.weighted_by_opacity(sample, cam_from_object)[0]
