"""What a run that followed a camera live has achieved, as whoever uses its poses meets it.

The figures of a run, which programs may rely on:
  share_of_frames    frames that got a measured pose, of all that the camera has sent
  frames_sent, poses_ok  of which
  share_right        frames with a pose within 5 degrees and 0.05 units of the truth, of all that were sent
  carried            frames whose pose was carried on from before, and not measured; no error below is theirs
  poses_per_s        measured poses a second, from the first frame sent to the last answer
  latency_ms         {p50, p90, p99} from a frame's capture to its state; by_stage: name -> {p50, p90} of the time from
                     the message before to the stage's own; waiting: name -> what of that p50 the stage was not at work,
                     but its input under way or waiting for a place or a core
  rotation_error_deg, translation_error  {median, p99, max} of every measured pose against the truth
  covariance         {50, 90, 99}: the share of measured poses whose region of so many percent holds the truth
  wrong_while_tracking  poses with an error beyond the sequence's limits whose state says TRACKING
  states             state -> number of frames
  first_pose_s       from the first frame sent to the first state with a measured pose
  ready_s            from starting the processes until all are ready
  pss_mb             memory of all processes together, the command itself left out, at its highest; what they share is
                     counted once; pss_mb_by_process: name -> its part of that
  cpu_s_by_process   name -> seconds, its start included
  jitter             {rotation_deg, translation}, see `jitter`
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import psutil

from fieldpose.deploy.evaluation.scores import coverage
from fieldpose.deploy.processes.memory import pss_mb
from fieldpose.deploy.processes.pipeline import Progress
from fieldpose.deploy.reporting.results import CLOSE, CLOSE_DEG, FrameResult, RunResult, summarise
from fieldpose.stages.geometry import Limit, inverse, log_se3, mahalanobis_squared

RIGHT = Limit(CLOSE_DEG, CLOSE)
"""The limits of the paper's table I, by which a pose is right."""
JITTER_FRAMES = 15
_OTHERS = "others"
_SAMPLE_S = 1.0


class Watcher:
    """Looks at a run while it lasts: when all was ready, and the memory of its processes at its highest.

    `report` is told each phase once. ready_s: None until all are ready. memory_mb: name -> MB.
    """

    def __init__(self, report: Callable[[str], None]) -> None:
        self.ready_s: float | None = None
        self.memory_mb: dict[str, float] = {}
        self._report = report
        self._began = self._looked = time.monotonic()
        self._phase = ""

    def __call__(self, progress: Progress) -> None:
        now = time.monotonic()
        if progress.phase != self._phase:
            self._report(progress.phase)
        self._phase = progress.phase
        if progress.phase == "starting":
            return
        if self.ready_s is None:
            self.ready_s = now - self._began
        if now - self._looked >= _SAMPLE_S or progress.phase == "finishing":
            self._looked = now
            self.memory_mb = max(self.memory_mb, _memory_mb(progress.pids), key=lambda found: sum(found.values()))


def _memory_mb(pids: Mapping[str, int]) -> dict[str, float]:
    """Of every process below this one, by name; those that have none are counted together."""
    names = {pid: name for name, pid in pids.items()}
    found: dict[str, float] = {}
    for child in psutil.Process().children(recursive=True):
        megabytes = pss_mb(child.pid)
        if megabytes is not None:
            name = names.get(child.pid, _OTHERS)
            found[name] = found.get(name, 0.0) + megabytes
    return found


def figures_of(run: RunResult, watched: Watcher, limit: Limit) -> dict[str, Any]:
    """The figures of a run, under the keys that this module's description lists.

    limit: of the sequence, beyond which a pose is wrong.
    """
    summary = summarise(run)
    found = [frame for frame in run.frames if frame.cam_from_object is not None]
    errors = np.array([frame.errors for frame in found if frame.errors is not None]).reshape(-1, 2)
    return {
        "frames_sent": run.sent,
        "poses_ok": len(found),
        "share_of_frames": len(found) / run.sent if run.sent else None,
        "share_right": _share_right(run),
        "carried": sum(frame.carried is not None for frame in run.frames),
        "poses_per_s": _poses_per_s(run.frames),
        "latency_ms": _latency_ms(run.frames, summary),
        "rotation_error_deg": _highest(errors[:, 0]),
        "translation_error": _highest(errors[:, 1]),
        "covariance": coverage(
            [
                mahalanobis_squared(frame.cam_from_object, frame.covariance, frame.true_pose)
                for frame in found
                if frame.cam_from_object is not None and frame.covariance is not None and frame.true_pose is not None
            ]
        ),
        "wrong_while_tracking": sum(
            frame.state == "tracking" and not _within(frame, limit) for frame in found if frame.errors is not None
        ),
        "states": summary["states"],
        "first_pose_s": _first_pose_s(run.frames),
        "ready_s": watched.ready_s,
        "pss_mb": sum(watched.memory_mb.values()) or None,
        "pss_mb_by_process": watched.memory_mb,
        "cpu_s_by_process": {name: stats["cpu_s"] for name, stats in summary["processes"].items()},
        "jitter": jitter(run.frames),
    }


def _share_right(run: RunResult) -> float | None:
    right = sum(frame.errors is not None and _within(frame, RIGHT) for frame in run.frames)
    return right / run.sent if run.sent else None


def jitter(frames: Sequence[FrameResult]) -> dict[str, float | None]:
    """How much successive poses tremble around the course that they take.

    Of each measured pose whose truth is known the error is the twist of pose x truth^-1, a motion of the camera in its
    own axes. What is left of it without its running mean over 15 successive such poses, of which it is the middle one
    (fewer at both ends), is what trembles: a constant or slow error is none. {rotation_deg, translation}: the root of
    the mean square of its length in degrees and in field units; None with fewer than two poses.
    """
    twists = [
        log_se3(frame.cam_from_object @ inverse(frame.true_pose))
        for frame in frames
        if frame.cam_from_object is not None and frame.true_pose is not None
    ]
    if len(twists) < 2:
        return {"rotation_deg": None, "translation": None}
    rest = np.array(twists) - _running_mean(np.array(twists), JITTER_FRAMES)
    shift, turn = (float(np.sqrt((part**2).sum(axis=1).mean())) for part in (rest[:, :3], rest[:, 3:]))
    return {"rotation_deg": float(np.rad2deg(turn)), "translation": shift}


def _running_mean(rows: np.ndarray, length: int) -> np.ndarray:
    """Of (n, k) rows, each with those around it as far as they are there."""
    sums = np.concatenate([np.zeros((1, rows.shape[1])), np.cumsum(rows, axis=0)])
    places = np.arange(len(rows))
    first, behind = np.maximum(places - length // 2, 0), np.minimum(places + length // 2 + 1, len(rows))
    return np.asarray((sums[behind] - sums[first]) / (behind - first)[:, None])


def _within(frame: FrameResult, limit: Limit) -> bool:
    turn, shift = frame.errors or (np.inf, np.inf)
    return turn <= limit.angle_deg and shift <= limit.distance


def _poses_per_s(frames: Sequence[FrameResult]) -> float:
    sent = [frame.sent_ns for frame in frames if frame.sent_ns is not None]
    answered = [frame.answered_ns for frame in frames if frame.answered_ns is not None]
    if not sent or not answered:
        return 0.0
    return sum(frame.cam_from_object is not None for frame in frames) / ((max(answered) - min(sent)) / 1e9)


def _first_pose_s(frames: Sequence[FrameResult]) -> float | None:
    sent = [frame.sent_ns for frame in frames if frame.sent_ns is not None]
    found = [f.answered_ns for f in frames if f.cam_from_object is not None and f.answered_ns is not None]
    return (min(found) - min(sent)) / 1e9 if sent and found else None


def _latency_ms(frames: Sequence[FrameResult], summary: Mapping[str, Any]) -> dict[str, Any]:
    ages = [frame.age_ms for frame in frames if frame.age_ms is not None]
    by_stage = summary["latency_ms"]["by_stage"]
    return {
        **{f"p{q}": float(np.percentile(ages, q)) if ages else None for q in (50, 90, 99)},
        "by_stage": by_stage,
        "waiting": {
            name: max(0.0, latency["p50"] - summary["processes"][name]["busy_ms_p50"])
            for name, latency in by_stage.items()
            if latency["p50"] is not None and name in summary["processes"]
        },
    }


def _highest(values: np.ndarray) -> dict[str, float] | None:
    if not len(values):
        return None
    median, p99 = np.percentile(values, (50, 99))
    return {"median": float(median), "p99": float(p99), "max": float(values.max())}
