"""What a fault did: how soon tracking was back, what was lost, whether it was told, and whether a pose was wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fieldpose.bus.messages import TrackingState
from fieldpose.deploy.benchmarks.chaos.events import SUPERVISOR, Event, Kind
from fieldpose.deploy.benchmarks.chaos.injector import Done
from fieldpose.deploy.processes.liveness import Fault
from fieldpose.deploy.reporting.results import FrameResult
from fieldpose.stages.geometry import Limit, rotation_error_deg, translation_error

IN_TIME_S = 2.0
_STEADY_S, _STEADY_SHARE, _STEADY_FRAMES = 0.5, 0.8, 5
_LATE_NS = 5_000_000_000
"""A last sign of life may be heard as long after an event as the machine keeps the looks away from it."""


@dataclass
class Verdict:
    """Of one event. back_s: from the end of its cause until tracking was steady; problems: what was not as it must be.

    away_s: from the event itself until the cause was gone; without_pose: frames in all that time that were not tracked.
    """

    event: Event
    back_s: float | None = None
    away_s: float | None = None
    without_pose: int = 0
    problems: list[str] = field(default_factory=list)

    def judge_time(self) -> None:
        """One more problem where tracking was not back in time."""
        if self.back_s is None or self.back_s > IN_TIME_S:
            late = "never" if self.back_s is None else f"after {self.back_s:.1f} s"
            self.problems.append(f"tracks again {late}")

    @property
    def row(self) -> dict[str, Any]:
        """As the JSON file has it."""
        return {
            "kind": str(self.event.kind), "process": self.event.process, "away_s": self.away_s, "back_s": self.back_s,
            "frames_without_pose": self.without_pose, "problems": self.problems,
        }  # fmt: skip


def judged(done: Sequence[Done], frames: Sequence[FrameResult], faults: Sequence[Fault]) -> list[Verdict]:
    """A verdict on each event of a run that went on after it, and one more problem for each false alarm."""
    left = list(faults)
    verdicts = []
    for i, one in enumerate(done):
        until_ns = done[i + 1].at_ns if i + 1 < len(done) else None
        verdict = _of_event(one, frames, until_ns)
        verdict.problems += _untold(one, left)
        verdicts.append(verdict)
    if left and verdicts:
        names = ", ".join(f"{fault.process} {fault.what}" for fault in left)
        verdicts[-1].problems.append(f"reported though nothing was done to it: {names}")
    return verdicts


def back_s(frames: Sequence[FrameResult], gone_ns: int, until_ns: int | None = None) -> float | None:
    """From `gone_ns` until the first frame of a stretch that is tracked, _STEADY_SHARE of _STEADY_S; None without one.

    By when states came, up to `until_ns`.
    """
    answered = sorted(
        (frame.answered_ns, is_tracked(frame))
        for frame in frames
        if frame.answered_ns is not None
        and frame.answered_ns >= gone_ns
        and (until_ns is None or frame.answered_ns < until_ns)
    )
    times = np.array([at for at, _ in answered], dtype=np.int64)
    tracked = np.array([ok for _, ok in answered], dtype=bool)
    ends = np.searchsorted(times, times + int(_STEADY_S * 1e9))
    for first, end in enumerate(ends):
        whole = times[-1] - times[first] >= _STEADY_S * 0.9e9
        if whole and tracked[first] and tracked[first:end].mean() >= _STEADY_SHARE and end - first >= _STEADY_FRAMES:
            return float(times[first] - gone_ns) / 1e9
    return None


def is_tracked(frame: FrameResult) -> bool:
    """Whether a frame's pose was measured and is said to be sure."""
    return frame.cam_from_object is not None and frame.state == TrackingState.TRACKING


@dataclass(frozen=True)
class Wrong:
    """A pose that was said to be TRACKING and was not where the camera is; carried: it was not measured."""

    frame_id: int
    rotation_error_deg: float
    translation_error: float
    carried: bool


def wrong(frames: Sequence[FrameResult], limit: Limit) -> list[Wrong]:
    """The poses, measured or carried on, that are said to be TRACKING and are beyond the limit."""
    found = []
    for frame in frames:
        pose = frame.cam_from_object if frame.cam_from_object is not None else frame.carried
        if frame.state != TrackingState.TRACKING or pose is None or frame.true_pose is None:
            continue
        turn, shift = rotation_error_deg(pose, frame.true_pose), translation_error(pose, frame.true_pose)
        if turn > limit.angle_deg or shift > limit.distance:
            found.append(Wrong(frame.frame_id, float(turn), float(shift), frame.cam_from_object is None))
    return found


def _of_event(done: Done, frames: Sequence[FrameResult], until_ns: int | None) -> Verdict:
    verdict = Verdict(done.event)
    if done.gone_ns is None:
        verdict.problems.append("the run ended before its cause was gone")
        return verdict
    verdict.away_s = (done.gone_ns - done.at_ns) / 1e9
    verdict.back_s = back_s(frames, done.gone_ns, until_ns)
    verdict.judge_time()
    back_ns = done.gone_ns + int((verdict.back_s or 0.0) * 1e9)
    verdict.without_pose = sum(done.at_ns <= frame.capture_ns <= back_ns and not is_tracked(frame) for frame in frames)
    return verdict


def _untold(done: Done, faults: list[Fault]) -> list[str]:
    """Takes the fault that tells of an event out of those that are left; a problem where there is none."""
    event = done.event
    gone_ns = done.gone_ns or done.at_ns
    for fault in faults:
        # It may have been silent for long before, on a machine with other work.
        around = fault.silent_ns <= gone_ns + _LATE_NS and (fault.back_ns is None or fault.back_ns >= done.at_ns)
        if fault.process == event.process and around:
            faults.remove(fault)
            expected = "ended" if event.kind is Kind.KILL else "hung"
            return [] if fault.what == expected else [f"reported as {fault.what}"]
    if event.kind is Kind.PAUSE or event.process == SUPERVISOR:
        return []
    return ["not reported"]
