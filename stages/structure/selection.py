"""Which frames of a video to find cameras for: sharp ones, evenly along the way that the picture moved.

Time says nothing: a hand rests, and hurries. What moves is told by corners that are followed from frame to frame.
Source: Lucas and Kanade, An iterative image registration technique (1981).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

import cv2
import numpy as np

from fieldpose.stages.geometry.arrays import Image

STRIDE = 0.04
"""Of the image's longer side that a picture moves from a chosen frame to the next: two thirds of a phone's picture are
then shared by frames that are six apart."""
FEWEST = 40
"""Frames of a video, if so many differ: around an object that stays in the middle, the picture moves little."""
BLURRED = 0.6
"""A frame is blurred that is less sharp than its neighbours by this factor, where the best of a window is taken."""
_NEIGHBOURS = 4
_HELD = 4
"""Times as many frames as are wanted are held while it is not known how long the way will be."""
_FOLLOWED_SIDE, _SHARP_SIDE = 320, 800
_NOISE_PX = 0.8
_CORNERS, _QUALITY, _APART_PX = 200, 0.01, 7
_FEWEST = 12
_LOST = 2 * STRIDE
"""How far a picture counts as moved in which too few corners are found again, as in a cut or a jerk."""
_Payload = TypeVar("_Payload")


@dataclass(frozen=True)
class Measured:
    """How far a picture has moved since the one before, as a share of its longer side, and how sharp it is."""

    moved: float
    sharpness: float


class Meter:
    """Measures the frames of one video, in their order."""

    def __init__(self) -> None:
        self._before: np.ndarray | None = None

    def __call__(self, image: Image) -> Measured:
        """Of the next frame, (h, w, 3) uint8."""
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        small, before = _shrunk(grey, _FOLLOWED_SIDE), self._before
        self._before = small
        moved = 0.0 if before is None else _LOST if before.shape != small.shape else _moved(before, small)
        return Measured(moved, sharpness(grey))


def sharpness(grey: np.ndarray) -> float:
    """How fine the detail of grey values (h, w) uint8 is: second derivatives by first ones, whatever the contrast."""
    values = cv2.GaussianBlur(_shrunk(grey, _SHARP_SIDE).astype(np.float32), (0, 0), _NOISE_PX)
    first = cv2.Sobel(values, cv2.CV_32F, 1, 0) ** 2 + cv2.Sobel(values, cv2.CV_32F, 0, 1) ** 2
    second = cv2.Laplacian(values, cv2.CV_32F) ** 2
    return float(np.sqrt(second.mean() / max(float(first.mean()), 1e-9)))


@dataclass(frozen=True)
class Candidate(Generic[_Payload]):
    """A frame that may be chosen: its number, what was measured, the way until it, and what the caller keeps of it."""

    number: int
    sharpness: float
    way: float
    payload: _Payload


class Chooser(Generic[_Payload]):
    """Takes the frames of a video one by one and keeps the sharpest of each part of the way, few of them at a time.

    In the end there are at most `most`, a STRIDE apart, or nearer to each other where they would be less than FEWEST.
    """

    def __init__(self, most: int) -> None:
        self._most, self._part = most, STRIDE / 8
        self._way, self._window, self._new = 0.0, -1, True
        self._kept: list[Candidate[_Payload]] = []
        self.seen = 0

    def wants(self, measured: Measured) -> bool:
        """Whether the next frame is the sharpest of its part so far; it is counted as seen."""
        self.seen += 1
        self._way += measured.moved
        window = int(self._way / self._part)
        self._new, self._window = window != self._window, window
        return self._new or measured.sharpness > self._kept[-1].sharpness

    def keep(self, measured: Measured, payload: _Payload) -> None:
        """Keep the frame that was just wanted, in place of its part's less sharp one."""
        if not self._new:
            self._kept.pop()
        self._kept.append(Candidate(self.seen - 1, measured.sharpness, self._way, payload))
        if len(self._kept) > _HELD * self._most:
            self._kept = thinned(self._kept, _HELD * self._most // 2)
            self._part *= 2
            self._window = int(self._way / self._part)

    def chosen(self) -> tuple[list[Candidate[_Payload]], list[Candidate[_Payload]]]:
        """The frames in their order, and those that are left out since they are blurred."""
        wanted = max(int(np.ceil(self._way / STRIDE)), FEWEST)
        kept = thinned(self._kept, min(wanted, self._most))
        typical = _running_median(np.array([c.sharpness for c in kept]))
        blurred = np.array([c.sharpness for c in kept]) < BLURRED * typical
        return (
            [c for c, b in zip(kept, blurred, strict=True) if not b],
            [c for c, b in zip(kept, blurred, strict=True) if b],
        )


def thinned(kept: list[Candidate[_Payload]], most: int) -> list[Candidate[_Payload]]:
    """At most so many, the sharpest of each of as many equal parts of the way."""
    if len(kept) <= most:
        return list(kept)
    first, last = kept[0].way, kept[-1].way
    part = np.minimum((np.array([c.way for c in kept]) - first) / max(last - first, 1e-12) * most, most - 1).astype(int)
    best: dict[int, Candidate[_Payload]] = {}
    for candidate, index in zip(kept, part.tolist(), strict=True):
        if index not in best or candidate.sharpness > best[index].sharpness:
            best[index] = candidate
    return list(best.values())


def _running_median(values: np.ndarray) -> np.ndarray:
    return np.array([np.median(values[max(0, i - _NEIGHBOURS) : i + _NEIGHBOURS + 1]) for i in range(len(values))])


def _moved(before: np.ndarray, now: np.ndarray) -> float:
    corners = cv2.goodFeaturesToTrack(before, _CORNERS, _QUALITY, _APART_PX)
    if corners is None or len(corners) < _FEWEST:
        return 0.0 if np.abs(before.astype(np.float32) - now).mean() < 1 else _LOST
    found, status, _ = cv2.calcOpticalFlowPyrLK(before, now, corners, None)  # type: ignore[call-overload]
    good = status.ravel() == 1
    if good.sum() < _FEWEST:
        return _LOST
    lengths = np.linalg.norm((found - corners).reshape(-1, 2)[good], axis=1)
    return float(np.median(lengths)) / max(now.shape)


def _shrunk(grey: np.ndarray, side: int) -> np.ndarray:
    scale = side / max(grey.shape)
    if scale >= 1:
        return grey
    size = (max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale)))
    return cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
