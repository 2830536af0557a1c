"""Structured logs of one process, on stderr, and a throttle for what could repeat with every message."""

from __future__ import annotations

import sys
import time
import traceback

import structlog


def stage_logger(stage: str) -> structlog.typing.FilteringBoundLogger:
    """A logger whose every line says which stage wrote it."""
    logger = structlog.wrap_logger(
        structlog.PrintLogger(sys.stderr),
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="%H:%M:%S.%f", utc=False),
            structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty()),
        ],
        wrapper_class=structlog.make_filtering_bound_logger("info"),
    )
    return logger.bind(stage=stage)


def describe(error: BaseException) -> str:
    """An exception in one line, with the place that raised it."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({frames[-1].filename.rsplit('/', 1)[-1]}:{frames[-1].lineno})" if frames else ""
    return f"{type(error).__name__}: {' '.join(str(error).split())[:300]}{place}"


class Throttle:
    """Logs each kind of warning at most once a second, and says how many it kept back."""

    def __init__(self, logger: structlog.typing.FilteringBoundLogger, period_s: float = 1.0) -> None:
        self._logger = logger
        self._period_s = period_s
        self._last: dict[str, float] = {}
        self._kept_back: dict[str, int] = {}

    def warning(self, kind: str, **fields: object) -> None:
        now = time.monotonic()
        if now - self._last.get(kind, -self._period_s) < self._period_s:
            self._kept_back[kind] = self._kept_back.get(kind, 0) + 1
            return
        self._last[kind] = now
        self._logger.warning(kind, kept_back=self._kept_back.pop(kind, 0), **fields)
