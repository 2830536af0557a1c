"""The frames of a run that went worst, and what was wrong with each, in words."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from scipy.stats import chi2

from fieldpose.deploy.evaluation.scores import DIMENSIONS
from fieldpose.deploy.reporting.reasons import reason_in_words
from fieldpose.deploy.reporting.results import FrameResult
from fieldpose.stages.geometry import mahalanobis_squared
from fieldpose.stages.tracking.scoring import deviations

_APART = 5
"""Frames of a video between two that are shown: neighbours go wrong alike."""
_OUTSIDE = 0.99
_LEAST = 1e-12


@dataclass(frozen=True)
class Bad:
    """A frame that went badly, and why; in_a_row: how many there were with the same, of which it is the middle one."""

    result: FrameResult
    why: str
    in_a_row: int = 1


def worst(frames: Sequence[FrameResult], count: int = 10) -> list[Bad]:
    """At most `count` frames, oldest first of each kind: without a pose, then with the largest errors.

    Where no errors are known, those with the lowest scores take their place. Frames without a pose in a row for the
    same reason are one. Those that were dropped, or have no pose because the object is out of view, did not go badly.
    """
    missed = sorted(_without_pose(frames), key=lambda bad: -bad.in_a_row)
    found = [(place, frame) for place, frame in enumerate(frames) if frame.cam_from_object is not None]
    ranked = _apart(sorted(found, key=_badness(frames), reverse=True), count)
    told = missed[: max(count // 2, count - len(ranked))]
    shown = [Bad(frame, _of_pose(frame)) for frame in ranked[: count - len(told)]]
    return [*sorted(told, key=lambda bad: bad.result.capture_ns), *shown]


def squared_distances(frames: Sequence[FrameResult]) -> list[float]:
    """Squared errors by the covariances that were stated, of all poses that have one and whose truth is known."""
    known = (_squared_distance(frame) for frame in frames)
    return [squared for squared in known if squared is not None]


def _squared_distance(frame: FrameResult) -> float | None:
    if frame.cam_from_object is None or frame.covariance is None or frame.true_pose is None:
        return None
    return mahalanobis_squared(frame.cam_from_object, frame.covariance, frame.true_pose)


def _without_pose(frames: Sequence[FrameResult]) -> Iterator[Bad]:
    worked_on = [frame for frame in frames if frame.outcome != "dropped"]
    for reason, run in groupby(worked_on, key=_missed):
        row = list(run)
        if reason is not None:
            yield Bad(row[len(row) // 2], f"no pose: {reason}", len(row))


def _missed(frame: FrameResult) -> str | None:
    """Why a frame that should have a pose has none, in words."""
    unseen = frame.truth is not None and frame.true_pose is None
    if frame.cam_from_object is not None or unseen:
        return None
    if frame.reason is None:
        return "no stage has answered in time" if frame.outcome == "lost" else "nothing was measured"
    return reason_in_words(frame.reason)


def _badness(frames: Sequence[FrameResult]) -> Callable[[tuple[int, FrameResult]], float]:
    """How bad a pose is; one that was claimed where the object is out of view is worst of all."""
    errors = [frame.errors for frame in frames if frame.errors is not None]
    usual = np.maximum(np.median(errors, axis=0), _LEAST) if errors else np.ones(2)

    def badness(placed: tuple[int, FrameResult]) -> float:
        _, frame = placed
        if frame.truth is not None and frame.true_pose is None:
            return np.inf
        if frame.errors is not None:
            return float(np.max(frame.errors / usual))
        return -np.inf if errors else -frame.score

    return badness


def _apart(ranked: Sequence[tuple[int, FrameResult]], count: int) -> list[FrameResult]:
    """The worst of these, worst first: no near neighbours, unless there are too few others."""
    chosen: list[tuple[int, FrameResult]] = []
    for place, frame in ranked:
        if all(abs(place - other) >= _APART for other, _ in chosen):
            chosen.append((place, frame))
        if len(chosen) == count:
            break
    places = {place for place, _ in chosen}
    chosen += [(place, frame) for place, frame in ranked if place not in places][: count - len(chosen)]
    return [frame for _, frame in chosen]


def _of_pose(frame: FrameResult) -> str:
    words = []
    if frame.errors is not None:
        words.append("{:.3g} degrees and {:.3g} units off".format(*frame.errors))
    elif frame.truth is not None:
        words.append("a pose was given where the object is out of view")
    if frame.covariance is not None:
        shift, turn = deviations(frame.covariance)
        words.append(f"stated standard deviations: {turn:.2g} degrees, {shift:.2g} units")
    squared = _squared_distance(frame)
    if squared is not None and squared > chi2.ppf(_OUTSIDE, DIMENSIONS):
        words.append(f"the truth is outside the {_OUTSIDE:.0%} region")
    words.append(f"{frame.state}, score {frame.score:.2f}")
    if frame.reason is not None:
        words.append(reason_in_words(frame.reason))
    return "; ".join(words)
