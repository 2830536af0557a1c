"""Memory of fieldpose's processes at its highest."""

from __future__ import annotations

import subprocess
import sys

# What wait4() says of a child includes its parent's memory at the time of the fork.
_TELL = """
with open("/proc/self/status") as status:
    print([line for line in status if line.startswith("VmHWM")][0].split()[1])
"""


def peak_mb(code: str, *arguments: object) -> float:
    """Run Python code in a process of its own; its highest resident memory in MB. Raises CalledProcessError."""
    command = [sys.executable, "-P", "-c", code + _TELL, *(str(argument) for argument in arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return int(done.stdout.split()[-1]) / 1024
