"""A Kalman filter of the camera's pose and velocity on SE(3).

The error state is a left twist of the pose and a change of its velocity, a left twist per second; accelerations are
white noise, whose strength follows from how far measurements are from what was expected of them, so that calm motion
is smoothed and fast motion is not held back. Source: Barfoot, State estimation for robotics (2017), chapters 7 and 8.
"""

from __future__ import annotations

import numpy as np

from fieldpose.stages.geometry import adjoint, exp_se3, inverse, log_se3
from fieldpose.stages.geometry.arrays import Covariance, Transform

_NS = 1e-9
_LONGEST_S = 0.25
"""After a longer time without a measurement the next one begins anew."""
_FORGETS = 0.15
"""How much of the strength of accelerations each measurement renews, where it does not ask for more."""
_BY_CHANCE = 3.0
"""Squared errors of so many times what is known of them are no sign of an acceleration: one in fifty is larger."""
_CALM, _CALM_SHARE = np.deg2rad(5.0), 0.1
"""Least accelerations, a second squared: of rotation, and of translation as a share of the distance."""


class PoseFilter:
    """Filters cam_from_object; times may come in any order, and those that do not advance replace nothing."""

    def __init__(self) -> None:
        self._time_ns: int | None = None
        self._pose = np.eye(4)
        self._velocity = np.zeros(6)
        self._covariance = np.zeros((12, 12))
        self._power = np.zeros(2)

    def reset(self) -> None:
        """Forget everything."""
        self._time_ns = None

    def update(self, capture_ns: int, measured: Transform, noise: Covariance) -> tuple[Transform, Covariance]:
        """The filtered pose (4, 4) at a measurement of it, with its covariance (6, 6).

        noise: covariance of the measurement's own error, which is new each time. One that is not after the last, or
        too long after it, is given back as it is.
        """
        between_s = None if self._time_ns is None else (capture_ns - self._time_ns) * _NS
        if between_s is not None and between_s <= 0:
            return measured, noise
        if between_s is None or between_s > _LONGEST_S:
            self._begin(capture_ns, measured, noise)
            return measured, noise
        self._time_ns = capture_ns
        expected, covariance = self._predicted(between_s)
        off = log_se3(measured @ inverse(expected))
        covariance += _driven(self._strength(off, covariance[:6, :6] + noise, between_s, measured), between_s)
        gain = covariance[:, :6] @ np.linalg.inv(covariance[:6, :6] + noise)
        correction = gain @ off
        self._pose = exp_se3(correction[:6]) @ expected
        self._velocity = self._velocity + correction[6:]
        kept = np.eye(12)
        kept[:, :6] -= gain
        self._covariance = kept @ covariance @ kept.T + gain @ noise @ gain.T
        return self._pose, self._covariance[:6, :6].copy()

    def _begin(self, capture_ns: int, measured: Transform, noise: Covariance) -> None:
        self._time_ns, self._pose, self._velocity = capture_ns, measured, np.zeros(6)
        self._covariance = np.zeros((12, 12))
        self._covariance[:6, :6] = noise
        distance = float(np.linalg.norm(measured[:3, 3]))
        self._covariance[6:, 6:] = np.diag([distance**2] * 3 + [1.0] * 3)
        self._power = np.zeros(2)

    def _predicted(self, between_s: float) -> tuple[Transform, np.ndarray]:
        moved = exp_se3(self._velocity * between_s)
        transition = np.eye(12)
        transition[:6, :6] = adjoint(moved)
        transition[:6, 6:] = between_s * np.eye(6)
        return moved @ self._pose, transition @ self._covariance @ transition.T

    def _strength(self, off: np.ndarray, known: Covariance, between_s: float, measured: Transform) -> np.ndarray:
        """Variances (6,) of accelerations that explain how far the measurement is off, beside what is known."""
        distance = float(np.linalg.norm(measured[:3, 3]))
        least = np.array([_CALM_SHARE * distance, _CALM]) ** 2
        by_chance = [_BY_CHANCE * np.trace(known[part, part]) for part in _PARTS]
        unexplained = (np.array([(off[part] ** 2).sum() for part in _PARTS]) - by_chance) / 3
        now = np.maximum(unexplained, 0) * (2 / between_s**2) ** 2
        self._power = np.maximum(np.maximum(now, (1 - _FORGETS) * self._power), least)
        return np.repeat(self._power, 3)


_PARTS = (slice(0, 3), slice(3, 6))


def _driven(strength: np.ndarray, between_s: float) -> np.ndarray:
    """Covariance (12, 12) of what an acceleration that is constant over so long does."""
    effect = np.concatenate([between_s**2 / 2 * np.eye(6), between_s * np.eye(6)])
    return (effect * strength) @ effect.T
