"""Shared memory that killed processes have left: files in /dev/shm, which Zenoh removes only when it next starts."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_FOLDER = Path("/dev/shm")
_SUFFIX = ".zenoh"


@contextmanager
def removed_orphans() -> Iterator[None]:
    """In the end remove this user's segments that no process has open, and those that this one has come to have open.

    For a run of other processes that are gone then: who got messages by a segment holds it open as long as it lives.
    Zenoh goes by open files as well. Does nothing where there is no /dev/shm.
    """
    before = segments_of([os.getpid()])
    try:
        yield
    finally:
        left = {path for path in _segments() if _is_mine(path)} - before
        left -= segments_of(_pids_but(os.getpid())) if left else set()
        for path in left:
            with suppress(OSError):
                path.unlink()


def segments_of(pids: Iterable[int]) -> set[Path]:
    """The segments that processes have open; of one that is gone, none."""
    return {path for pid in pids for path in _opened_by(pid) if path.parent == _FOLDER and path.suffix == _SUFFIX}


def _segments() -> list[Path]:
    try:
        return [path for path in _FOLDER.iterdir() if path.suffix == _SUFFIX]
    except OSError:
        return []


def _is_mine(path: Path) -> bool:
    try:
        return path.stat().st_uid == os.getuid()
    except OSError:
        return False


def _pids_but(one: int) -> Iterator[int]:
    """Of all processes, of which this user's may be looked at."""
    return (pid for folder in Path("/proc").glob("[0-9]*") if (pid := int(folder.name)) != one)


def _opened_by(pid: int) -> set[Path]:
    found = set()
    with suppress(OSError):
        for link in Path(f"/proc/{pid}/fd").iterdir():
            with suppress(OSError):
                found.add(Path(os.readlink(link)))
    return found
