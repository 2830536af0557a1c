"""A constant-velocity model of the camera on SE(3)."""

from __future__ import annotations

import bisect

import numpy as np

from fieldpose.stages.geometry import exp_se3, inverse, log_se3
from fieldpose.stages.tracking.config import MotionConfig

NS_PER_MS = 1e6
_REMEMBERED = 16
_LEAST_BETWEEN_NS = 1_000_000
"""Poses nearer in time, as wrong stamps have them, tell nothing of the velocity."""


class MotionModel:
    """Predicts cam_from_object at a time from the poses before it.

    The velocity is a left twist per second (the camera's own frame), so a camera that keeps turning and moving the
    same way is predicted exactly as long as damping is off.
    """

    def __init__(self, config: MotionConfig, scale: float = 1.0) -> None:
        self._config = config
        self._max_rotation = np.deg2rad(config.most.angle_deg)
        self._max_translation = config.most.distance * scale
        self._times_ns: list[int] = []
        self._poses: list[np.ndarray] = []

    def __len__(self) -> int:
        return len(self._poses)

    @property
    def newest_ns(self) -> int:
        """Capture time of the newest pose; there must be one."""
        return self._times_ns[-1]

    @property
    def newest(self) -> np.ndarray:
        """The newest pose; there must be one."""
        return self._poses[-1]

    def reset(self) -> None:
        """Forget all poses: after a loss, what was before says nothing about what comes."""
        self._times_ns.clear()
        self._poses.clear()

    def add(self, capture_ns: int, cam_from_object: np.ndarray) -> None:
        """Take in a pose; poses may come in any order of capture, and a second one of a time replaces the first."""
        at = bisect.bisect_left(self._times_ns, capture_ns)
        if at < len(self._times_ns) and self._times_ns[at] == capture_ns:
            self._poses[at] = cam_from_object
            return
        self._times_ns.insert(at, capture_ns)
        self._poses.insert(at, cam_from_object)
        del self._times_ns[:-_REMEMBERED], self._poses[:-_REMEMBERED]

    def within_horizon(self, capture_ns: int) -> bool:
        """Whether the newest pose is recent enough for its motion to be carried on to that time."""
        return bool(self._poses) and capture_ns - self.newest_ns <= self._config.horizon_ms * NS_PER_MS

    def velocity(self) -> np.ndarray:
        """Left twist (6,) per second; zero with fewer than two poses near in time."""
        reference = self._reference()
        if reference is None:
            return np.zeros(6)
        between_s = (self._times_ns[-1] - self._times_ns[reference]) * 1e-9
        return log_se3(self._poses[-1] @ inverse(self._poses[reference])) / between_s

    def predict(self, capture_ns: int, damped: bool = True) -> np.ndarray:
        """cam_from_object (4, 4) at a time after (or before) the newest pose; there must be one.

        Not damped: as if the velocity did not decay.
        """
        ahead_s = (capture_ns - self._times_ns[-1]) * 1e-9
        ahead_s = self._damped(ahead_s) if damped else ahead_s
        return exp_se3(self._clamped(self.velocity() * ahead_s)) @ self._poses[-1]

    def _reference(self) -> int | None:
        if len(self._times_ns) < 2:
            return None
        newest = self._times_ns[-1]
        first = bisect.bisect_left(self._times_ns, newest - int(self._config.window_ms * NS_PER_MS))
        first = min(first, len(self._times_ns) - 2)
        while first > 0 and newest - self._times_ns[first] < _LEAST_BETWEEN_NS:
            first -= 1
        if newest - self._times_ns[first] < _LEAST_BETWEEN_NS:
            return None
        return first if newest - self._times_ns[first] <= self._config.horizon_ms * NS_PER_MS else None

    def _damped(self, ahead_s: float) -> float:
        decay_s = self._config.damping_ms * 1e-3
        if not np.isfinite(decay_s) or decay_s <= 0:
            return ahead_s if decay_s > 0 else 0.0
        return float(np.sign(ahead_s) * decay_s * -np.expm1(-abs(ahead_s) / decay_s))

    def _clamped(self, twist: np.ndarray) -> np.ndarray:
        turn, shift = float(np.linalg.norm(twist[3:])), float(np.linalg.norm(twist[:3]))
        share = min(1.0, self._max_rotation / max(turn, 1e-12), self._max_translation / max(shift, 1e-12))
        return twist * share
