"""Which lines of our own modules an input reaches."""

from __future__ import annotations

import re
import sys
from types import CodeType, FrameType
from typing import Any

_OURS = ("/bus/", "/stages/", "/deploy/", "/fieldpose/")


class Reach:
    """Counts ways, a way being a line and the one before it, that no input has gone before."""

    def __init__(self) -> None:
        self._seen: set[tuple[int, int, int]] = set()
        self._told: set[str] = set()
        self._ours: dict[CodeType, bool] = {}
        self._new = 0
        self._last = 0

    def begin(self) -> None:
        """Watch this thread from here on."""
        self._new = self._last = 0
        sys.settrace(self._call)

    def end(self, told: str) -> bool:
        """Watch no more; whether anything was new, be it the way or, but for its numbers and names, what was said."""
        sys.settrace(None)
        shape = re.sub(r"'[^']*'|\"[^\"]*\"|[0-9.e+-]+|/\S+", "", told)[:120]
        new = self._new > 0 or shape not in self._told
        self._told.add(shape)
        return new

    @property
    def ways(self) -> int:
        return len(self._seen)

    def _call(self, frame: FrameType, event: str, arg: Any) -> Any:
        code = frame.f_code
        ours = self._ours.get(code)
        if ours is None:
            name = code.co_filename
            ours = self._ours[code] = any(part in name for part in _OURS) and "site-packages" not in name
        return self._line if ours else None

    def _line(self, frame: FrameType, event: str, arg: Any) -> Any:
        way = (id(frame.f_code), self._last, frame.f_lineno)
        self._last = frame.f_lineno
        if way not in self._seen:
            self._seen.add(way)
            self._new += 1
        return self._line
