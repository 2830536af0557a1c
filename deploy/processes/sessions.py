"""Ending a process, and what is left of a session of processes whose leader is gone."""

from __future__ import annotations

import os
import subprocess
import time
from contextlib import suppress
from typing import Any

import psutil

_POLL_S = 0.02


def end(process: subprocess.Popen[Any], patience_s: float) -> None:
    """Ask a process to end, and see to it. Returns once it is gone."""
    process.terminate()
    try:
        process.wait(patience_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def end_session(leader: int, patience_s: float) -> None:
    """See to it that all of a session end, those by force that do not by themselves: one that is stopped hears nothing.

    Returns once they are gone.
    """
    deadline = time.monotonic() + patience_s
    while (left := _members(leader)) and time.monotonic() < deadline:
        time.sleep(_POLL_S)
    for process in left:
        with suppress(psutil.NoSuchProcess):
            process.kill()
    while _members(leader) and time.monotonic() < deadline + patience_s:
        time.sleep(_POLL_S)


def _members(leader: int) -> list[psutil.Process]:
    return [process for pid in psutil.pids() if _session_of(pid) == leader and (process := _running(pid)) is not None]


def _session_of(pid: int) -> int:
    try:
        return os.getsid(pid)
    except OSError:
        return 0


def _running(pid: int) -> psutil.Process | None:
    """The process; None for one that has ended, whether or not its parent has noticed."""
    try:
        process = psutil.Process(pid)
        return None if process.status() == psutil.STATUS_ZOMBIE else process
    except psutil.NoSuchProcess:
        return None
