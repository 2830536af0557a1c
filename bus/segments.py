"""Shared memory that killed processes have left: files in /dev/shm, which Zenoh removes only when it next starts."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

_FOLDER = Path("/dev/shm")
_SUFFIX = ".zenoh"


def remove_orphans() -> list[Path]:
    """Remove segments of this user that no process has open; returns them. Does nothing where there is no /dev/shm.

    Zenoh holds a segment open as long as it uses it, and goes by the same.
    """
    left = {path for path in _segments() if _is_mine(path)}
    for held in _open_files() if left else ():
        left.discard(held)
    for path in left:
        with suppress(OSError):
            path.unlink()
    return sorted(left)


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


def _open_files() -> list[Path]:
    """Of all processes that may be looked at: all of this user's."""
    found = []
    for folder in Path("/proc").glob("[0-9]*/fd"):
        with suppress(OSError):
            for link in folder.iterdir():
                with suppress(OSError):
                    found.append(Path(os.readlink(link)))
    return found
