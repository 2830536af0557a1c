"""Frames as their sources give them, and the feed that says when each is due; the time is always an argument."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Literal

import numpy as np

from fieldpose.bus.messages import CameraOrigin, Encoding
from fieldpose.errors import ConfigError
from fieldpose.stages.camera.config import CameraConfig, Pace
from fieldpose.stages.geometry import Camera

_BURST = 8
_DEFAULT_RATE_HZ = 30.0
_HELD_UP_NS = 10**9
_LONGEST_WAIT_S = 1.0
"""A clock that is set back meanwhile is noticed after that."""
Clock = Literal["none", "own", "wall"]


@dataclass(frozen=True)
class TruePose:
    """What a source knows of a frame's pose: cam_from_object (4, 4), None where the object is out of view."""

    cam_from_object: np.ndarray | None


@dataclass(frozen=True)
class CapturedFrame:
    """An image (height, width, 3) uint8 RGB, or the bytes (n,) of a jpeg or png file.

    at_ns is its time by the source's clock; None where the source has none.
    """

    frame_id: int
    image: np.ndarray
    encoding: Encoding
    camera: Camera
    name: str
    at_ns: int | None = None
    truth: TruePose | None = None
    origin: CameraOrigin = CameraOrigin.CALIBRATED


@dataclass(frozen=True)
class Source:
    """`frames(first)` reads from the frame at that place on; it raises FieldposeError where one cannot be read.

    clock: "own" for frames with times since some moment of their own, "wall" since the epoch, as they are taken.
    """

    description: str
    clock: Clock
    frames: Callable[[int], Iterator[CapturedFrame]]
    length: int | None = None

    def check(self, config: CameraConfig) -> None:
        """Raise ConfigError for what is asked of its frames and cannot be."""
        if self.clock == "wall" and (config.first or config.speed != 1.0):
            raise ConfigError("camera: a device has no frames to leave out, and one speed; leave out first and speed")
        pace = self.pace(config.pace)
        if pace != "live" and config.speed != 1.0:
            raise ConfigError(f"camera: speed {config.speed:g} is for pace live, and this pace is {pace}")

    def pace(self, wanted: Pace) -> Pace:
        """The pace to send at. ConfigError for a device that is to wait."""
        if self.clock == "wall" and wanted == "lockstep":
            raise ConfigError("camera: a device does not wait for answers; choose pace live or fast")
        if wanted != "auto":
            return wanted
        return "lockstep" if self.clock == "none" else "live"


class Feed:
    """Gives each frame when it is due, and knows when all have been answered; `first` were sent before."""

    def __init__(self, source: Source, config: CameraConfig, first: int = 0) -> None:
        source.check(config)
        self._pace = source.pace(config.pace)
        self._clock = source.clock
        self._rate_hz, self._speed = config.rate_hz, config.speed
        self._timeout_ns = int(config.answer_timeout_s * 1e9)
        self._left = None if config.frames is None else config.frames - first
        self._frames = source.frames(config.first + first * config.every)
        self._sent_ones = islice(self._frames, 0, None, config.every)
        self._next: CapturedFrame | None = None
        self._exhausted = False
        self._start: tuple[int, int] | None = None
        self._now_ns = 0
        self._sent = 0
        self._objects: tuple[str | None, ...] = config.objects or (None,)
        self._awaited: int | None = None
        self._unheard: set[str | None] = set()
        self._in_flight: dict[str | None, int] = {}
        self._last_sign_ns = 0
        self.unanswered = 0
        self.held_up_ns = 0

    def due(self, now_ns: int) -> Iterator[tuple[CapturedFrame, int]]:
        """Frames to send now, each with its capture time since the epoch; a device is waited for.

        Live ones that are more than a second late, as after the machine was suspended, move all that follow
        (`held_up_ns` is how far), and so does a clock that is set back.

        Raises what the source raises where it cannot be read on.
        """
        if self._plays and now_ns < self._now_ns:
            self._move(now_ns - self._now_ns)
        self._now_ns = now_ns
        for _ in range(1 if self._clock == "wall" else _BURST):
            frame = self._peek() if self._may_send(now_ns) else None
            if frame is None:
                return
            capture_ns = self._capture_ns(frame, now_ns)
            if self._plays:
                if capture_ns > now_ns:
                    return
                if now_ns - capture_ns > _HELD_UP_NS:
                    # A camera does not make up for a pause by frames in a rush.
                    self.held_up_ns += now_ns - capture_ns
                    self._move(now_ns - capture_ns)
                    capture_ns = now_ns
            self._note_sent(frame, now_ns)
            yield frame, capture_ns

    def wait_s(self, now_ns: int) -> float | None:
        """How long until it may be due again; None where that is not known (yet)."""
        if self._next is None or not self._plays or self._start is None:
            return None
        return min(max(self._capture_ns(self._next, now_ns) - now_ns, 0) * 1e-9, _LONGEST_WAIT_S)

    def sign_of_life(self, frame_id: int, now_ns: int) -> None:
        """A pass over that frame has come back."""
        if frame_id == self._awaited:
            self._last_sign_ns = now_ns

    def answered(self, frame_id: int, in_flight: int, now_ns: int, object: str | None = None) -> None:
        """Tracking of an object is done with that frame, and has `in_flight` others left."""
        self.sign_of_life(frame_id, now_ns)
        self._in_flight[object] = in_flight
        if frame_id == self._awaited:
            self._unheard.discard(object)
            if not self._unheard:
                self._awaited = None

    def over(self, now_ns: int) -> bool:
        """Whether the source has ended, and the last frame is answered or will not be."""
        if not self._exhausted:
            return False
        return (self._awaited is None and not any(self._in_flight.values())) or self._silent(now_ns)

    def close(self) -> None:
        """Let go of the source's files and devices."""
        close = getattr(self._frames, "close", None)
        if close is not None:
            close()

    @property
    def _plays(self) -> bool:
        """Whether it gives frames that are there already as a camera would."""
        return self._pace == "live" and self._clock != "wall"

    def _move(self, by_ns: int) -> None:
        """Have all frames that are still to come later by so much."""
        if self._start is not None:
            self._start = (self._start[0] + by_ns, self._start[1])

    def _may_send(self, now_ns: int) -> bool:
        if self._pace != "lockstep" or self._awaited is None:
            return True
        if self._peek() is None or not self._silent(now_ns):
            return False
        self.unanswered += 1
        return True

    def _silent(self, now_ns: int) -> bool:
        return now_ns - self._last_sign_ns > self._timeout_ns

    def _peek(self) -> CapturedFrame | None:
        if self._next is None and not self._exhausted:
            self._next = next(self._sent_ones, None) if self._left is None or self._sent < self._left else None
            self._exhausted = self._next is None
        return self._next

    def _capture_ns(self, frame: CapturedFrame, now_ns: int) -> int:
        if self._clock == "wall" and frame.at_ns is not None:
            return frame.at_ns
        rate_hz = self._rate_hz
        if self._clock == "none" and self._pace == "live":
            rate_hz = rate_hz or _DEFAULT_RATE_HZ
        if rate_hz is None and frame.at_ns is None:
            return now_ns
        at_ns = frame.at_ns if rate_hz is None else round(self._sent * 1e9 / rate_hz)
        self._start = self._start or (now_ns, at_ns or 0)
        since_ns = (at_ns or 0) - self._start[1]
        return self._start[0] + (since_ns if self._speed == 1.0 else round(since_ns / self._speed))

    def _note_sent(self, frame: CapturedFrame, now_ns: int) -> None:
        self._next = None
        self._sent += 1
        self._awaited, self._unheard = frame.frame_id, set(self._objects)
        self._last_sign_ns = now_ns
