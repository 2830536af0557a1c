"""Holding BLAS to one thread while threads of our own share the work."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from threading import RLock

from threadpoolctl import threadpool_limits


class SingleThreadedBlas:
    """Holds the BLAS of the process to one thread while anyone wants it, then gives it back the threads it had."""

    def __init__(self) -> None:
        # An owner that is garbage collected may release BLAS in the midst of another's hold, in the same thread.
        self._lock = RLock()
        self._holds: set[object] = set()
        self._limits: threadpool_limits | None = None

    def hold(self, owner: object) -> Callable[[], object]:
        """Hold BLAS until the returned function is called or the owner is garbage collected."""
        hold = object()
        with self._lock:
            self._holds.add(hold)
            if self._limits is None:
                self._limits = threadpool_limits(limits=1, user_api="blas")
        return weakref.finalize(owner, self._release, hold)

    def _release(self, hold: object) -> None:
        with self._lock:
            self._holds.discard(hold)
            if not self._holds and self._limits is not None:
                limits, self._limits = self._limits, None
                limits.restore_original_limits()
