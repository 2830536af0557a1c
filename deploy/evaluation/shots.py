"""The frames of a sequence that is being edited, and the stretches of it in which something happens."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import cast

import numpy as np

from fieldpose.errors import UsageError
from fieldpose.stages.camera.core import CapturedFrame

Repaint = Callable[[np.ndarray], tuple[np.ndarray, float]]
"""From an image (h, w, 3) uint8 RGB to another of its shape, and the share, 0 to 1, that still shows the scene."""
Effect = Callable[[float, np.ndarray], tuple[np.ndarray, float]]
"""The same, so many seconds after a stretch began."""

NS_PER_S = 1_000_000_000
LEAD_S, TAIL_S = 1.0, 1.5
"""Left as it is before and after a stretch: time to be tracking, and to be tracking again."""


@dataclass(frozen=True)
class Shot:
    """A frame that will be sent: its number, stamp, camera and truth, and the image that `repaint` starts from.

    source_id: the frame's number in the source. edited: the edit shows here, in the pixels, camera, stamp or order, or
    because the frame is repeated, or the first one after a cut or a gap.
    """

    frame: CapturedFrame
    source_id: int
    repaint: Repaint | None = None
    edited: bool = False

    @property
    def at_ns(self) -> int:
        """Frames of recordings have stamps."""
        return cast(int, self.frame.at_ns)

    def at(self, at_ns: int) -> Shot:
        """The same with another stamp."""
        return replace(self, frame=replace(self.frame, at_ns=at_ns))


def shots_of(frames: Iterable[CapturedFrame]) -> list[Shot]:
    """Frames of a recording as they are, numbered from 0."""
    return numbered([Shot(frame, frame.frame_id) for frame in frames])


def numbered(shots: Iterable[Shot]) -> list[Shot]:
    """The shots with frame_ids from 0, in their order."""
    return [replace(shot, frame=replace(shot.frame, frame_id=i)) for i, shot in enumerate(shots)]


def marked(shot: Shot) -> Shot:
    """The same, as one where the edit shows."""
    return replace(shot, edited=True)


def period_ns(shots: Sequence[Shot]) -> int:
    """The usual time from one frame to the next. Raises UsageError where there is none."""
    steps_ns = np.diff([shot.at_ns for shot in shots])
    usual_ns = int(np.median(steps_ns)) if len(steps_ns) else 0
    if usual_ns <= 0:
        raise UsageError(f"this edit needs frames with running stamps, but the part chosen has {len(shots)} without")
    return usual_ns


def run_on(parts: Iterable[Sequence[Shot]], period_ns: int) -> list[Shot]:
    """The parts one after the other, numbered anew; each begins a period after the end of the one before."""
    result: list[Shot] = []
    for part in filter(len, parts):
        shift_ns = result[-1].at_ns + period_ns - part[0].at_ns if result else 0
        result += [shot.at(shot.at_ns + shift_ns) for shot in part]
    return numbered(result)


def stretches(shots: Sequence[Shot], rng: np.random.Generator, seconds: float, every_s: float) -> list[range]:
    """Where in the sequence something happens for so many seconds: about once in every `every_s`, at least once.

    Each is somewhere in a slot of its own, LEAD_S after its begin or later, and over TAIL_S before its end or earlier.
    Raises UsageError where the sequence is too short for one.
    """
    times_s = np.array([shot.at_ns - shots[0].at_ns for shot in shots]) / NS_PER_S
    count = max(1, int(times_s[-1] / every_s))
    slot_s = times_s[-1] / count
    spare_s = slot_s - LEAD_S - seconds - TAIL_S
    if spare_s < 0:
        needed = LEAD_S + seconds + TAIL_S
        raise UsageError(f"the part chosen lasts {times_s[-1]:.2f} s, but this edit needs {needed:g} s")
    begins_s = [slot * slot_s + LEAD_S + rng.uniform(0, spare_s) for slot in range(count)]
    first, end = (np.searchsorted(times_s, np.array(begins_s) + after_s) for after_s in (0, seconds))
    return [range(int(a), int(max(b, a + 1))) for a, b in zip(first, end, strict=True)]


def repainted(shots: Sequence[Shot], stretch: range, effect: Effect) -> list[Shot]:
    """The shots, those of the stretch with an effect."""
    result = list(shots)
    for i in stretch:
        seconds = (shots[i].at_ns - shots[stretch.start].at_ns) / NS_PER_S
        result[i] = marked(replace(shots[i], repaint=partial(effect, seconds)))
    return result
