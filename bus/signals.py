"""SIGTERM and SIGINT as a wish to stop."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any


class Interrupted(BaseException):
    """A signal to stop that came while nobody looked at the event."""


class StopSignals:
    """In the main thread, SIGTERM and SIGINT set `stop` while the context lasts, and a second one sets `again`.

    While `raising` lasts the first also raises Interrupted, out of whatever the main thread is doing.
    """

    def __init__(self, stop: threading.Event | None = None) -> None:
        self.stop = stop or threading.Event()
        self.again = threading.Event()
        self._raising = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> StopSignals:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGTERM, signal.SIGINT):
                self._before[number] = signal.signal(number, self._caught)
        return self

    def __exit__(self, *_: object) -> None:
        for number, before in self._before.items():
            signal.signal(number, before)

    @contextmanager
    def raising(self) -> Iterator[None]:
        """Raises Interrupted also for a signal that came before; what is closed after it is not interrupted."""
        self._raising = True
        try:
            if self.stop.is_set():
                raise Interrupted
            yield
        finally:
            self._raising = False

    def _caught(self, number: int, frame: FrameType | None) -> None:
        (self.again if self.stop.is_set() else self.stop).set()
        if self._raising:
            self._raising = False
            raise Interrupted
