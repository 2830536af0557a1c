"""What processes take of this machine's memory."""

from __future__ import annotations

import re
from pathlib import Path

_PSS = re.compile(r"^Pss:\s+(\d+) kB$", re.MULTILINE)


def pss_mb(pid: int) -> float | None:
    """A process's proportional set size, in MiB: pages that n processes share count 1/n, so that sums count each once.

    None where the process is gone or another user's, and where the system does not tell (Linux alone does).
    """
    try:
        found = _PSS.search(Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii"))
    except OSError:
        return None
    return int(found[1]) / 1024 if found else None
