"""How a pipeline begins by itself: started anew at each of several views, without a guess, until its first answer.

The figures, which programs may rely on:
  views              how many; each is a run of its own
  share_right        first answers within 5 degrees and 0.05 units of the truth, of all views
  share_answered     views that got an answer at all
  share_in_time      first answers that were right, and came within a second of the first frame
  first_pose_s       {p50, p90, max} from the first frame's capture to the first state with a measured pose
  ready_s            the median of the time from starting the processes until all are ready
  not_right          of each view without a right first answer: name, first_pose_s, rotation_error_deg,
                     translation_error, null without an answer
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from fieldpose.bus.recording import RecordingWriter
from fieldpose.deploy.benchmarks import machine
from fieldpose.deploy.benchmarks.followed import RIGHT
from fieldpose.deploy.benchmarks.track import held_to
from fieldpose.deploy.commands.run import planned
from fieldpose.deploy.evaluation.film import FrameLog
from fieldpose.deploy.processes.pipeline import run_pipeline
from fieldpose.deploy.reporting.results import RunResult
from fieldpose.deploy.settings import Settings
from fieldpose.errors import UsageError
from fieldpose.stages.camera.config import CameraConfig
from fieldpose.stages.camera.core import CapturedFrame, Source
from fieldpose.stages.camera.sources import is_video, open_source

_RATE_HZ = 30.0
_IN_TIME_S = 1.0

Report = Callable[[str], None]


@dataclass(frozen=True)
class Start:
    """What came first: seconds since the first frame, degrees and units of error; None without an answer."""

    name: str
    first_pose_s: float | None
    rotation_error_deg: float | None
    translation_error: float | None
    ready_s: float

    @property
    def right(self) -> bool:
        """Whether it is near the truth."""
        if self.rotation_error_deg is None or self.translation_error is None:
            return False
        return bool(self.rotation_error_deg <= RIGHT.angle_deg and self.translation_error <= RIGHT.distance)

    @property
    def in_time(self) -> bool:
        """Whether it is right and was soon there."""
        return self.right and self.first_pose_s is not None and self.first_pose_s <= _IN_TIME_S


def measure(field: Path, source: str, views: int, seconds: float, cores: int | None, report: Report) -> dict[str, Any]:
    """Start the pipeline at so many views spread over a source, each for so long.

    Raises UsageError where the source has no true poses, KeyboardInterrupt after a Ctrl-C, and what `run_pipeline`
    raises.
    """
    opened = open_source(CameraConfig(source))
    places = spread_over(sum(1 for _ in opened.frames(0)), views, round(seconds * _RATE_HZ) if is_video(source) else 1)
    starts = []
    with held_to(cores or machine.cores()), tempfile.TemporaryDirectory(prefix="fieldpose-") as folder:
        for i, place in enumerate(places):
            report(f"{source}: view {i + 1} of {len(places)}")
            starts.append(_start(field, _film(opened, source, place, seconds), Path(folder) / "start.mcap"))
    return {"machine": machine.describe(), "field": str(field), "source": source, **figures_of(starts)}


def spread_over(length: int, count: int, run: int) -> list[int]:
    """At most so many places, from the first frame to the last that has `run` frames from it on."""
    return sorted({round(place) for place in np.linspace(0, max(length - run, 0), count)})


def figures_of(starts: Sequence[Start]) -> dict[str, Any]:
    """The figures that this module's description lists."""
    times = [start.first_pose_s for start in starts if start.first_pose_s is not None]
    count = len(starts)
    return {
        "views": count,
        "share_right": sum(start.right for start in starts) / count if count else None,
        "share_answered": len(times) / count if count else None,
        "share_in_time": sum(start.in_time for start in starts) / count if count else None,
        "first_pose_s": dict(zip(("p50", "p90", "max"), map(float, np.percentile(times, (50, 90, 100))), strict=True))
        if times
        else None,
        "ready_s": float(np.median([start.ready_s for start in starts])) if starts else None,
        "not_right": [
            {
                "name": start.name,
                "first_pose_s": start.first_pose_s,
                "rotation_error_deg": start.rotation_error_deg,
                "translation_error": start.translation_error,
            }
            for start in starts
            if not start.right
        ],
    }


def _film(opened: Source, source: str, place: int, seconds: float) -> list[CapturedFrame]:
    """The frames from a place on, at their own times; of photos that one, as a camera that stands still sees it."""
    count = max(1, round(seconds * _RATE_HZ))
    if is_video(source):
        frames = list(islice(opened.frames(place), count))
    else:
        photo = next(opened.frames(place))
        frames = [replace(photo, frame_id=i, at_ns=round(i * 1e9 / _RATE_HZ)) for i in range(count)]
    if not any(frame.truth is not None for frame in frames):
        raise UsageError(f"bench start: {source} knows no true poses; expected dataset:DIR:test or mcap:FILE with them")
    return frames


def _start(field: Path, frames: Sequence[CapturedFrame], film: Path) -> Start:
    writer = RecordingWriter(film)
    log = FrameLog(writer)
    for frame in frames:
        log.write(frame)
    writer.close()
    run = run_pipeline(planned(replace(Settings(), camera=CameraConfig(f"mcap:{film}")), field))
    film.unlink()
    if run.interrupted:
        raise KeyboardInterrupt
    return first_answer(run, frames[0].name)


def first_answer(run: RunResult, name: str) -> Start:
    """What a run answered first."""
    began_ns = min((frame.capture_ns for frame in run.frames), default=0)
    answered = [
        (frame.answered_ns, frame)
        for frame in run.frames
        if frame.cam_from_object is not None and frame.answered_ns is not None
    ]
    if not answered:
        return Start(name, None, None, None, run.start_s)
    at_ns, first = min(answered, key=lambda one: one[0])
    turn, shift = first.errors or (None, None)
    return Start(name, (at_ns - began_ns) / 1e9, turn, shift, run.start_s)
