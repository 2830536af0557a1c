"""A world to track in: a camera's true path, training views around it, and a pipeline that takes its time."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from fieldpose.bus.messages import CameraOrigin, GuessReason, Reason, TrackingState
from fieldpose.stages.geometry import (
    Camera,
    Limit,
    exp_se3,
    look_at,
    pairwise,
    perturb,
    rotation_error_deg,
    translation_error,
)
from fieldpose.stages.nerf.training_views import TrainingViews
from fieldpose.stages.tracking.core import GuessOrder, LookOrder, Output, StateReport, Tracker
from fieldpose.stages.tracking.policy import Alike, FrameInfo, PoseResult

MS = 1_000_000
FRAME_MS = 1000 / 30
CAMERA = Camera(640, 480, 600.0, 600.0, 319.5, 239.5)
Path = Callable[[float], "np.ndarray | None"]
Retrieval = Callable[[FrameInfo], "Alike | None"]


def frame_info(
    frame_id: int = 0, capture_ns: int = 0, origin: CameraOrigin = CameraOrigin.CALIBRATED
) -> FrameInfo:  # fmt: skip
    return FrameInfo(frame_id, capture_ns, CAMERA, origin)


def on_sphere(azimuth_deg: float, elevation_deg: float, radius: float = 4.0) -> np.ndarray:
    """cam_from_object of a camera that looks at the origin."""
    azimuth, elevation = np.deg2rad(azimuth_deg), np.deg2rad(elevation_deg)
    eye = radius * np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    return look_at(eye, (0, 0, 0), (0, 0, 1))


def hand_held(seconds: float, speed: float = 1.0) -> np.ndarray:
    """A hand that sways: up to about 35 degrees per second at speed 1."""
    t = seconds * speed
    shake = exp_se3([0.02 * np.sin(7 * t), 0.02 * np.cos(5 * t), 0, 0.01 * np.sin(9 * t), 0.01 * np.sin(11 * t), 0])
    return shake @ on_sphere(30 * np.sin(t), 30 + 10 * np.sin(0.7 * t), 4 + 0.3 * np.sin(1.3 * t))


@dataclass
class World:
    """Runs a Tracker against a simulated pipeline, in steps of 5 ms of its own clock.

    The pipeline finds the pose if the guess is within its basin, with an error that grows with the guess's, and
    otherwise fails or, one time in five, finds nonsense with few inliers. One pass takes `service_ms` in a pipeline
    of which `latency_ms` is the whole length. `retrieval` answers a Look after `look_ms`, or never where it says None.
    """

    tracker: Tracker
    path: Path
    service_ms: float = 60.0
    latency_ms: Callable[[np.random.Generator], float] = lambda rng: 150.0
    loses: float = 0.0
    seed: int = 0
    distort: Callable[[int, PoseResult], PoseResult] = lambda frame_id, result: result
    retrieval: Retrieval = lambda frame: Alike(reason=Reason.NOT_AVAILABLE)
    look_ms: float = 20.0
    origin: CameraOrigin = CameraOrigin.CALIBRATED
    guesses: list[GuessOrder] = field(default_factory=list)
    looks: list[LookOrder] = field(default_factory=list)
    reports: list[StateReport] = field(default_factory=list)

    def run(self, seconds: float) -> World:
        rng = np.random.default_rng(self.seed)
        pending: list[tuple[int, int, Callable[[int], list[Output]]]] = []
        order, busy_until, frames = itertools.count(), 0, 0
        for now_ns in range(0, int(seconds * 1e9), 5 * MS):
            outputs = self.tracker.on_tick(now_ns)
            if now_ns >= frames * FRAME_MS * MS:
                outputs += self.tracker.on_frame(frame_info(frames, now_ns, self.origin), now_ns)
                frames += 1
            while pending and pending[0][0] <= now_ns:
                outputs += heapq.heappop(pending)[2](now_ns)
            self.reports += [output for output in outputs if isinstance(output, StateReport)]
            for look in (output for output in outputs if isinstance(output, LookOrder)):
                self.looks.append(look)
                alike = self.retrieval(look.frame)
                if alike is not None:
                    reply = partial(self.tracker.on_alike, look.frame.frame_id, alike)
                    heapq.heappush(pending, (now_ns + int(self.look_ms * MS), next(order), reply))
            for guess in (output for output in outputs if isinstance(output, GuessOrder)):
                self.guesses.append(guess)
                busy_until = max(busy_until, now_ns) + int(self.service_ms * MS)
                done = max(busy_until, now_ns + int(self.latency_ms(rng) * MS))
                if rng.random() >= self.loses:
                    result = self.distort(guess.frame.frame_id, self._solve(guess, rng))
                    heapq.heappush(pending, (done, next(order), partial(self.tracker.on_result, result)))
        return self

    def _solve(self, order: GuessOrder, rng: np.random.Generator) -> PoseResult:
        truth, guess = self.path(order.frame.capture_ns * 1e-9), order.guess.cam_from_object
        ids = order.frame.frame_id, order.pass_index
        off = np.inf if truth is None else Limit(35.0, 2.5).distance_ratio(truth, guess)
        if off < 1.0 and truth is not None:
            error = 0.005 * rng.standard_normal(6) * (0.3 + off)
            covariance = np.diag([1e-4] * 3 + [1e-5] * 3)
            return PoseResult(*ids, exp_se3(error) @ truth, covariance, int(150 * (1.2 - off)), 200, 1.0)
        if rng.random() < 0.2:
            return PoseResult(*ids, perturb(guess, rng, (20, 90), 1.0), None, int(rng.integers(6, 15)), 120, 3.0)
        return PoseResult(*ids, reason=Reason.NO_CONSENSUS)

    def states(self, since_s: float = 0.0, until_s: float = 1e9) -> list[TrackingState]:
        return [r.belief.state for r in self.between(since_s, until_s)]

    def between(self, since_s: float, until_s: float = 1e9) -> list[StateReport]:
        return [r for r in self.reports if since_s <= r.frame.capture_ns * 1e-9 < until_s]

    def worst_error(self, reports: list[StateReport]) -> tuple[float, float]:
        """Largest rotation (degrees) and translation error of the poses that were measured."""
        pairs = [
            (self.path(r.frame.capture_ns * 1e-9), r.belief.cam_from_object) for r in reports if r.belief.score > 0
        ]
        return max(rotation_error_deg(a, b) for a, b in pairs), max(translation_error(a, b) for a, b in pairs)

    def first_reasons(self) -> list[GuessReason]:
        return [order.guess.reason for order in self.guesses if order.pass_index == 0]


def ring_of_views() -> TrainingViews:
    """72 training views on the upper half of a sphere."""
    poses = [on_sphere(azimuth, elevation) for elevation in (10, 35, 60) for azimuth in range(0, 360, 15)]
    return TrainingViews(tuple(f"train/r_{i}.png" for i in range(len(poses))), np.stack(poses))


def most_alike(views: TrainingViews, path: Path, count: int = 3) -> Retrieval:
    """A retrieval that is right: the training views nearest to the truth, none where the object is out of view."""

    def retrieval(frame: FrameInfo) -> Alike:
        truth = path(frame.capture_ns * 1e-9)
        if truth is None:
            return Alike(reason=Reason.NOTHING_ALIKE)
        distances = pairwise(truth[None], views.cam_from_object, Limit(35.0, 2.5))[0]
        return Alike(list(views.cam_from_object[np.argsort(distances, kind="stable")[:count]]))

    return retrieval
