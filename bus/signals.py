"""SIGTERM and SIGINT as a wish to stop."""

from __future__ import annotations

import signal
import threading
from types import FrameType
from typing import Any


class Interrupted(BaseException):
    """A signal to stop that came while nobody looked at the event."""


class StopSignals:
    """In the main thread, SIGTERM and SIGINT set `stop` while the context lasts, and a second one sets `again`.

    While `interrupting` is true they also raise Interrupted, out of whatever the main thread is doing.
    """

    def __init__(self, stop: threading.Event | None = None) -> None:
        self.stop = stop or threading.Event()
        self.again = threading.Event()
        self.interrupting = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> StopSignals:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGTERM, signal.SIGINT):
                self._before[number] = signal.signal(number, self._caught)
        return self

    def __exit__(self, *_: object) -> None:
        for number, before in self._before.items():
            signal.signal(number, before)

    def _caught(self, number: int, frame: FrameType | None) -> None:
        (self.again if self.stop.is_set() else self.stop).set()
        if self.interrupting:
            raise Interrupted
