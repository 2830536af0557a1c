"""What a run has achieved: a row for each frame, and the figures that `--json` gives.

The keys of a summary, which programs may rely on:
  frames             frames that have come to an end, with a pose or without, of those that are remembered
  frames_forgotten   frames that came before: of a run the newest 100,000 are remembered, and all figures are of these
  frames_lost        of these, the frames that were given up because no answer came (a stage died)
  frames_sent        frames that the camera has sent
  dropped_at_the_door  frames that tracking has not answered and not let in, because enough were in flight
  poses_ok           frames with a measured pose
  frames_with_truth  frames whose true pose is known, with the object in view
  rotation_error_deg, translation_error  {mean, median, p90} over the frames with both poses; null without any
  share_re_below_5deg, share_te_below_0.05  over frames_with_truth: a frame without a pose counts as a failure;
                     null without any
  out_of_view        {frames, poses_ok}: frames whose truth says that the object is not in the picture
  rate_hz            finished frames a second, from the first frame sent to the last answer
  latency_ms         {p50, p90, p99, by_stage}: from the camera's sending a frame to its state, all passes included;
                     by_stage: name -> {p50, p90}, waiting and transport included
  passes             mean number of passes over a frame that the stages have worked on
  states             tracking's state -> number of frames
  reasons            why frames have no measured pose -> number of frames
  cameras            where the intrinsics of frames come from -> number of frames; poses by an assumed one are not sure
  plan               what was decided before the run, and why, by name
  messages           {recorded, lost}: lost are those that the recorder should have got and has not written (without
                     a recorder: those that a stage should have got)
  restarts           name of a process -> how often it came back
  faults             of each process that ended unasked or was hung, in the order found: process, what (ended or
                     hung), at_s (its last sign of life, from the first frame's sending), away_s (from there until its
                     successor was ready; null where the run ended before) and frames_without_pose (frames taken in
                     that time that have no measured pose)
  start_s            seconds until all processes were ready
  processes          name -> busy_ms_p50, busy_ms_p90, busy_s, cpu_s, rss_mb, failed, refused, gaps, skipped
"""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from fieldpose.bus.messages import Stats
from fieldpose.bus.reading import RecordingInfo
from fieldpose.bus.topics import Address
from fieldpose.deploy.graph import AT_WORK
from fieldpose.deploy.processes.liveness import Fault
from fieldpose.stages.geometry import Camera, rotation_error_deg, translation_error
from fieldpose.stages.tracking.scoring import deviations

Outcome = Literal["finished", "lost", "dropped"]

CLOSE_DEG, CLOSE = 5.0, 0.05
"""The limits of the paper's table I, in degrees and in units of the field."""

_STATS = ("busy_ms_p50", "busy_ms_p90", "busy_s", "cpu_s", "rss_mb", "failed", "refused", "gaps", "skipped")


@dataclass(frozen=True)
class TruthKnown:
    """A frame's true pose; None where the object is not in view."""

    cam_from_object: np.ndarray | None


@dataclass(frozen=True)
class FrameResult:
    """What became of a frame; `cam_from_object` is the pose measured, None where none was.

    carried: the pose that tracking carried on with where none was measured. covariance: (6, 6) of the pose's left
    twist, where it is known. level: how much was done to save time, where the pipeline adapts itself. camera: the
    frame's own, where it is known.
    """

    frame_id: int
    capture_ns: int
    outcome: Outcome
    passes: int = 1
    state: str | None = None
    score: float = 0.0
    reason: str | None = None
    camera_origin: str | None = None
    cam_from_object: np.ndarray | None = None
    carried: np.ndarray | None = None
    covariance: np.ndarray | None = None
    truth: TruthKnown | None = None
    sent_ns: int | None = None
    answered_ns: int | None = None
    stage_ms: Mapping[str, float] = field(default_factory=dict)
    level: int | None = None
    camera: Camera | None = None

    @property
    def true_pose(self) -> np.ndarray | None:
        """The true pose where it is known and the object in view."""
        return None if self.truth is None else self.truth.cam_from_object

    @property
    def errors(self) -> tuple[float, float] | None:
        """Rotation in degrees and translation in field units, where there are a pose and its truth."""
        if self.cam_from_object is None or self.true_pose is None:
            return None
        found, truth = self.cam_from_object, self.true_pose
        return rotation_error_deg(found, truth), translation_error(found, truth)

    @property
    def latency_ms(self) -> float | None:
        """From the camera's sending to the state."""
        if self.outcome != "finished" or self.sent_ns is None or self.answered_ns is None:
            return None
        return (self.answered_ns - self.sent_ns) / 1e6

    @property
    def age_ms(self) -> float | None:
        """From the frame's capture to the state; it means something where frames are sent as they are captured."""
        if self.outcome != "finished" or self.answered_ns is None:
            return None
        return (self.answered_ns - self.capture_ns) / 1e6


@dataclass(frozen=True)
class RunResult:
    """What a run has left: its frames, and what was heard of its processes.

    `sent`: frames by the camera's own numbers; `forgotten`: how many came before `frames`; `observed`: messages that
    the command itself has heard, by key;
    `recording_error`: why not everything was recorded that should have been; `interrupted`: by Ctrl-C or SIGTERM,
    before the source had ended; `start_s`: until all processes were ready.
    """

    frames: Sequence[FrameResult]
    sent: int = 0
    stats: Mapping[str, Stats] = field(default_factory=dict)
    observed: Mapping[str, int] = field(default_factory=dict)
    restarts: Mapping[str, int] = field(default_factory=dict)
    faults: Sequence[Fault] = ()
    recording: RecordingInfo | None = None
    plan: Mapping[str, str] = field(default_factory=dict)
    recording_error: str | None = None
    interrupted: bool = False
    start_s: float = 0.0
    forgotten: int = 0


def summarise(run: RunResult) -> dict[str, Any]:
    """The figures of a run, under the keys that this module's description lists."""
    admitted = [result for result in run.frames if result.outcome != "dropped"]
    latencies = [result.latency_ms for result in admitted if result.latency_ms is not None]
    passes = [result.passes for result in admitted if result.passes]
    return {
        "frames": len(admitted),
        "frames_lost": sum(result.outcome == "lost" for result in admitted),
        "frames_forgotten": run.forgotten,
        "frames_sent": run.sent,
        "dropped_at_the_door": max(0, run.sent - run.forgotten - len(admitted)),
        "poses_ok": sum(result.cam_from_object is not None for result in admitted),
        **accuracy(admitted),
        "rate_hz": rate_hz(admitted),
        "latency_ms": {**_quantiles(latencies, (50, 90, 99)), "by_stage": _by_stage(admitted)},
        "passes": float(np.mean(passes)) if passes else None,
        "states": dict(Counter(result.state for result in admitted if result.state is not None)),
        "reasons": dict(Counter(result.reason for result in admitted if result.reason is not None)),
        "cameras": dict(Counter(result.camera_origin for result in admitted if result.camera_origin is not None)),
        "plan": dict(run.plan),
        "messages": _messages(run),
        "restarts": dict(run.restarts),
        "faults": [_fault(fault, run.frames) for fault in run.faults],
        "start_s": run.start_s,
        "processes": {name: {key: getattr(s, key) for key in _STATS} for name, s in sorted(run.stats.items())},
    }


def accuracy(results: Sequence[FrameResult]) -> dict[str, Any]:
    """Errors of the poses, and the shares of frames that are close to the truth."""
    with_truth = [result for result in results if result.true_pose is not None]
    errors = [result.errors for result in with_truth if result.errors is not None]
    unseen = [result for result in results if result.truth is not None and result.true_pose is None]
    turns, shifts = [error[0] for error in errors], [error[1] for error in errors]
    return {
        "frames_with_truth": len(with_truth),
        "rotation_error_deg": spread(turns),
        "translation_error": spread(shifts),
        "share_re_below_5deg": _share(turns, CLOSE_DEG, len(with_truth)),
        "share_te_below_0.05": _share(shifts, CLOSE, len(with_truth)),
        "out_of_view": {
            "frames": len(unseen),
            "poses_ok": sum(result.cam_from_object is not None for result in unseen),
        },
    }


def rate_hz(results: Sequence[FrameResult]) -> float:
    """Finished frames a second, from the first frame sent to the last answer."""
    spans = [(r.sent_ns, r.answered_ns) for r in results if r.outcome == "finished"]
    known = [(sent, answered) for sent, answered in spans if sent is not None and answered is not None]
    if not known:
        return 0.0
    seconds = (max(answered for _, answered in known) - min(sent for sent, _ in known)) / 1e9
    return len(known) / seconds if seconds > 0 else 0.0


def to_csv(pipelines: Iterable[tuple[Address, Sequence[FrameResult]]]) -> bytes:
    """A row for each frame; sigma_ are standard deviations of its pose, in field units and degrees."""
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(
        ["frame_id", "capture_ns", "outcome", "state", "score", "reason", "camera", "passes", "latency_ms"]
        + ["rotation_error_deg", "translation_error", "sigma_translation", "sigma_rotation_deg"]
        + [f"cam_from_object_{row}{column}" for row in range(3) for column in range(4)]
        + ["object", "camera_name"]
    )
    for address, result in ((address, result) for address, results in pipelines for result in results):
        turn, shift = result.errors or ("", "")
        sigmas = ("", "") if result.covariance is None else deviations(result.covariance)
        pose = [""] * 12 if result.cam_from_object is None else result.cam_from_object[:3].ravel().tolist()
        columns = [result.frame_id, result.capture_ns, result.outcome, result.state, result.score, result.reason]
        columns += [result.camera_origin, result.passes]
        writer.writerow([*columns, result.latency_ms, turn, shift, *sigmas, *pose, address.object, address.camera])
    return text.getvalue().encode()


def _messages(run: RunResult) -> dict[str, int]:
    """Missing are numbers that a sender's own count leaves out, or what only the command itself has heard."""
    if run.recording is None:
        return {"recorded": 0, "lost": sum(stats.gaps for stats in run.stats.values())}
    missing: Counter[str] = Counter()
    for source in run.recording.sources:
        missing[source.key] += source.missing + source.received - source.written
    recorded = Counter({topic.key: topic.messages for topic in run.recording.topics})
    lost = sum(
        max(missing[key], run.observed.get(key, 0) - recorded[key]) for key in missing.keys() | run.observed.keys()
    )
    return {"recorded": run.recording.messages, "lost": lost}


def _fault(fault: Fault, frames: Sequence[FrameResult]) -> dict[str, Any]:
    sent = [frame.sent_ns for frame in frames if frame.sent_ns is not None]
    until_ns = fault.back_ns or max(sent, default=fault.silent_ns)
    missed = [frame for frame in frames if fault.silent_ns <= frame.capture_ns <= until_ns]
    return {
        "process": fault.process,
        "what": fault.what,
        "at_s": (fault.silent_ns - min(sent)) / 1e9 if sent else None,
        "away_s": fault.away_s,
        "frames_without_pose": sum(frame.cam_from_object is None for frame in missed),
    }


def _by_stage(results: Sequence[FrameResult]) -> dict[str, dict[str, float | None]]:
    stages = {name: [r.stage_ms[name] for r in results if name in r.stage_ms] for name in AT_WORK}
    return {name: _quantiles(values, (50, 90)) for name, values in stages.items()}


def _quantiles(values: Sequence[float], percents: Sequence[int]) -> dict[str, float | None]:
    return {f"p{q}": float(np.percentile(values, q)) if values else None for q in percents}


def spread(values: Sequence[float]) -> dict[str, float] | None:
    """Mean, median and 90th percentile; None without any value."""
    if not values:
        return None
    median, p90 = np.percentile(values, (50, 90))
    return {"mean": float(np.mean(values)), "median": float(median), "p90": float(p90)}


def _share(values: Sequence[float], limit: float, total: int) -> float | None:
    return sum(value < limit for value in values) / total if total else None
