"""Whether images may pass between processes of this host through shared memory.

Zenoh locks in memory what it maps: a sender its pool, a receiver the pools of all that it hears (1.10.2). What a
receiver may not lock it cannot read, and loses without a word. So a process that may not lock plenty says to the others
that it has no shared memory, and gets what they send over TCP.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

FOLDER = Path("/dev/shm")
_POOL_BYTES = 32 << 20
"""A sender comes to use all of it before it uses any again; room for five full-HD images as pixels."""
_LEAST_LOCKED_BYTES = 32 * _POOL_BYTES
"""The pools of more senders than a host has cores for."""
_LEAST_FREE_BYTES = 8 * _POOL_BYTES
_CAP_IPC_LOCK = 14


def settings() -> dict[str, Any]:
    """Zenoh's, by path, of a process that may be limited in what it locks, or find little room."""
    return {
        "transport/shared_memory/enabled": lockable_bytes() >= _LEAST_LOCKED_BYTES,
        "transport/shared_memory/transport_optimization/enabled": hindrance() is None,
        "transport/shared_memory/transport_optimization/pool_size": _POOL_BYTES,
    }


def hindrance() -> str | None:
    """Why images of this process go over TCP, and what would mend it; None where they do not."""
    if not FOLDER.is_dir():
        return f"there is no {FOLDER}"
    lockable, free = lockable_bytes(), free_bytes()
    if lockable < _LEAST_LOCKED_BYTES:
        needed_mb = _LEAST_LOCKED_BYTES >> 20
        return f"this user may lock {lockable / 2**20:.0f} MB of memory; allow {needed_mb} (ulimit -l, LimitMEMLOCK)"
    # Pools that outgrow it (64 MB in many containers) end a process with SIGBUS; each sender has one.
    if free < _LEAST_FREE_BYTES:
        return f"{FOLDER} has {free / 2**20:.0f} MB free; give it {_LEAST_FREE_BYTES >> 20} (docker: --shm-size)"
    return None


def lockable_bytes() -> float:
    """How much memory this process may keep from being swapped out; infinite where nobody counts."""
    try:
        import resource

        limit, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    except (ImportError, AttributeError, OSError):  # not of this system
        return float("inf")
    return float("inf") if limit == resource.RLIM_INFINITY or _may_lock_all() else float(limit)


def _may_lock_all() -> bool:
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return False
    held = next((line.partition(":")[2] for line in lines if line.startswith("CapEff:")), "0")
    return bool(int(held, 16) >> _CAP_IPC_LOCK & 1)


def free_bytes() -> int:
    """The room in FOLDER; 0 where that cannot be told."""
    try:
        return shutil.disk_usage(FOLDER).free
    except OSError:
        return 0
