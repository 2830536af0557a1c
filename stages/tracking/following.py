"""Tracking where every frame is followed: an answer to each at once, and solves beside it on some."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf

import numpy as np

from fieldpose.bus.requests import MOST_SOLVES_PER_S
from fieldpose.stages.alignment.images import FramePyramid
from fieldpose.stages.following.config import POINTS_BY_LEVEL, FollowingConfig
from fieldpose.stages.following.core import Followed
from fieldpose.stages.geometry import Camera
from fieldpose.stages.geometry.arrays import Depth, Grey, Transform
from fieldpose.stages.tracking.certainty import with_camera
from fieldpose.stages.tracking.config import TrackingConfig
from fieldpose.stages.tracking.core import Counts, GuessOrder, Output, StateReport, Tracker
from fieldpose.stages.tracking.followed import FollowedPolicy
from fieldpose.stages.tracking.motion import NS_PER_MS
from fieldpose.stages.tracking.policy import Alike, FrameInfo, PoseResult

_SMOOTHING = 0.2
_EASED = 0.7
"""Following does more again where it takes less than this share of what it may."""
_LONGEST_AHEAD_MS = 500.0


@dataclass(frozen=True)
class FollowedReport:
    """What was measured of a frame, before it is believed."""

    frame: FrameInfo
    followed: Followed
    pass_index: int = 0


class FollowingTracker:
    """A Tracker of the frames that are solved, and around it the answer to every frame.

    At all times received = followed + missed: `admitted` and `finished` are those followed, `lost` is 0.

    patient: a frame that is being solved has its answer after that, for a source that waits for answers; then nothing
    depends on how long anything takes.
    """

    def __init__(
        self, config: TrackingConfig, following: FollowingConfig, policy: FollowedPolicy, patient: bool = False
    ) -> None:  # fmt: skip
        self._policy, self._following, self._patient = policy, following, patient
        self._held: StateReport | None = None
        self._solves = Tracker(replace(config, depth=1), policy)
        self._asked_ns: dict[int, int] = {}
        self._followed = self._missed = 0
        self._took_ms: float | None = None
        self._between_ms: float | None = None
        self._newest_ns: int | None = None

    @property
    def counts(self) -> Counts:
        """Of frames; those in flight are being solved, and answered already."""
        return Counts(
            received=self._followed + self._missed, admitted=self._followed, finished=self._followed,
            dropped_at_the_door=self._missed,
        )  # fmt: skip

    def on_frame(
        self, frame: FrameInfo, image: FramePyramid | None, now_ns: int, missed: int = 0
    ) -> list[Output | FollowedReport]:
        """Follow a frame, and have it solved where that is wanted."""
        self._note_interval(frame.capture_ns)
        self._followed += 1
        self._missed += missed
        belief, followed = self._policy.follow(frame, image)
        outputs: list[Output | FollowedReport] = [] if followed is None else [FollowedReport(frame, followed)]
        report = StateReport(frame, 0, with_camera(belief, frame), self.counts, self._policy.level)
        if self._patient:
            self._held = report
            return [*outputs, *self._ordered(self._solves.on_frame(frame, now_ns), now_ns)]
        return [*outputs, report, *self._ordered(self._solves.on_frame(frame, now_ns), now_ns)]

    def on_view(
        self, frame_id: int, view_id: str, grey: Grey, depth: Depth, camera: Camera, cam_from_object: Transform,
        now_ns: int,
    ) -> None:  # fmt: skip
        """A view is there; it serves following whatever comes of the solve."""
        asked_ns = self._asked_ns.pop(frame_id, None)
        if asked_ns is not None and not self._patient:
            took = min((now_ns - asked_ns) / NS_PER_MS, _LONGEST_AHEAD_MS)
            self._policy.ahead_ms += _SMOOTHING * (took - self._policy.ahead_ms)
        self._policy.follower.add(view_id, grey, depth, camera, cam_from_object)
        self._policy.viewed(frame_id, view_id)

    def on_prior(self, frame_id: int, cam_from_object: np.ndarray, now_ns: int) -> list[Output | FollowedReport]:
        """Take in a guess of a frame's pose from outside; it is used if it comes before the frame, or where lost."""
        return self._ordered(self._solves.on_prior(frame_id, cam_from_object, now_ns), now_ns)

    def on_alike(self, frame_id: int, alike: Alike, now_ns: int) -> list[Output | FollowedReport]:
        """Take in the answer to a Look."""
        return self._ordered(self._solves.on_alike(frame_id, alike, now_ns), now_ns)

    def on_result(self, result: PoseResult, now_ns: int) -> list[Output | FollowedReport]:
        """Take in what became of a pass over a frame."""
        return self._ordered(self._solves.on_result(result, now_ns), now_ns)

    def on_tick(self, now_ns: int) -> list[Output | FollowedReport]:
        """Give up solves that are past their deadline; call it often."""
        return self._ordered(self._solves.on_tick(now_ns), now_ns)

    @property
    def begins_at(self) -> Transform | None:
        """Where tracking begins when nothing is known of the camera; None where training views are tried."""
        return self._policy.begins_at

    @property
    def solves_per_s(self) -> float | None:
        """How often a frame is solved at least, whatever is followed."""
        return min(1000 / max(self._policy.solve_ms, 1e-3), MOST_SOLVES_PER_S)

    def solve_at_least(self, per_second: float) -> None:
        """Have a frame solved so often; 0: only where little is found or no view has seen what will be seen soon."""
        self._policy.solve_ms = 1000 / per_second if per_second > 0 else inf

    @property
    def keyframes(self) -> int | None:
        """How many views were kept because that was asked for."""
        return self._policy.follower.keyframes

    def take_keyframe(self) -> None:
        """See `FollowedPolicy.take_keyframe`. Raises RefusedError where nothing is tracked."""
        self._policy.take_keyframe()

    def restart(self, start: Transform | None, now_ns: int) -> list[Output | FollowedReport]:
        """Forget what is believed and what is being solved; the next frame begins at `start`, or as the first did.

        Views stay, for they are still true. The frames that are forgotten have had their answers.
        """
        self._asked_ns = {}
        return self._ordered(self._solves.restart(start, now_ns), now_ns)

    def took(self, ms: float) -> None:
        """Following a frame has taken so long; do less, or more again, if that is not what it may take."""
        if self._patient:
            return
        self._took_ms = ms if self._took_ms is None else self._took_ms + _SMOOTHING * (ms - self._took_ms)
        if self._between_ms is None:
            return
        share = self._took_ms / max(self._between_ms * self._following.budget, 1e-3)
        level = self._policy.level + int(share > 1) - int(share < _EASED)
        level = min(max(level, 0), len(POINTS_BY_LEVEL) - 1)
        if level != self._policy.level:
            self._policy.level, self._took_ms = level, None

    def _note_interval(self, capture_ns: int) -> None:
        if self._newest_ns is not None and capture_ns > self._newest_ns:
            between = (capture_ns - self._newest_ns) / NS_PER_MS
            usual = between if self._between_ms is None else self._between_ms
            self._between_ms = usual + _SMOOTHING * (min(between, 4 * usual) - usual)
        self._newest_ns = capture_ns

    def _ordered(self, outputs: list[Output], now_ns: int) -> list[Output | FollowedReport]:
        """What is to be done for solves; their frames have their states already."""
        orders = [output for output in outputs if not isinstance(output, StateReport)]
        for order in orders:
            if isinstance(order, GuessOrder):
                self._asked_ns = {order.frame.frame_id: now_ns}
        return [*orders, *self._answer(outputs)]

    def _answer(self, outputs: list[Output]) -> list[StateReport]:
        """The answer to the frame that waits for its solve, once that has left; with its pose, if it has none."""
        held = self._held
        if held is None or self._solves.counts.in_flight > 0:
            return []
        self._held = None
        solved = [output for output in outputs if isinstance(output, StateReport) and output.frame == held.frame]
        if solved and held.belief.score == 0 and solved[-1].belief.score > 0:
            return [replace(held, belief=solved[-1].belief)]
        return [held]
