"""What descending a colour difference takes: rays with their derivatives, and Adam.

A motion (shift 3, turn 3) is a twist of the object's frame that moves the camera: exp_se3(motion) @ object_from_cam.
"""

from __future__ import annotations

import numpy as np

from fieldpose.stages.geometry.rigid import skew
from fieldpose.stages.nerf.rendering_api import RayRenderer, RenderedRays

RGB = np.eye(3, dtype=np.float32)
_BETA1, _EPSILON = 0.9, 1e-8
_SERIES = 24


def rendered_with(
    renderer: RayRenderer, origins: np.ndarray, directions: np.ndarray
) -> tuple[RenderedRays, np.ndarray]:
    """Rays (n, 3) rendered, and the derivative (n, 3, 6) of their colours by the ray."""
    return renderer.render_rays_jacobian(
        np.ascontiguousarray(origins, np.float32), np.ascontiguousarray(directions, np.float32), RGB
    )


def left_jacobian(twist: np.ndarray) -> np.ndarray:
    """The (6, 6) J with exp_se3(twist + d) = exp_se3(J d) @ exp_se3(twist) for small d.

    The sum of ad^n / (n + 1)!; Barfoot, State Estimation for Robotics (2017), eq. 7.66.
    """
    ad = np.zeros((6, 6))
    ad[:3, :3] = ad[3:, 3:] = skew(twist[3:])
    ad[:3, 3:] = skew(twist[:3])
    total = np.eye(6)
    for n in range(_SERIES, 0, -1):
        total = np.eye(6) + ad @ total / (n + 1)
    return total


class Adam:
    """Steps of Adam for parameters of any shape; Kingma and Ba (2015)."""

    def __init__(self, shape: tuple[int, ...], beta2: float) -> None:
        self._first, self._second, self._beta2 = np.zeros(shape), np.zeros(shape), beta2
        self._count = 0

    def step(self, gradient: np.ndarray) -> np.ndarray:
        """The direction to add, times the learning rate, to the parameters."""
        self._count += 1
        self._first += (1 - _BETA1) * (gradient - self._first)
        self._second += (1 - self._beta2) * (gradient**2 - self._second)
        first = self._first / (1 - _BETA1**self._count)
        second = self._second / (1 - self._beta2**self._count)
        return -first / (np.sqrt(second) + _EPSILON)
