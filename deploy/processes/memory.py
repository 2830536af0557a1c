"""Memory of a process in which what it shares with others is counted once among them."""

from __future__ import annotations

from pathlib import Path


def pss_mb(pid: int) -> float | None:
    """A process's proportional set size in MB; None where it has ended, or the system does not tell."""
    try:
        text = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii")
    except OSError:
        return None
    sizes = [int(line.split()[1]) for line in text.splitlines() if line.startswith("Pss:")]
    return sizes[0] / 1024 if sizes else None
