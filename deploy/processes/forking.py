"""Stages forked from a process that has already imported what they need: no imports, and their memory is shared."""

from __future__ import annotations

import gc
import importlib
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import NoReturn

import psutil
from setproctitle import setproctitle

from fieldpose.deploy.processes.lifeline import die_with_parent

FIELDPOSE = (sys.executable, "-P", "-m", "fieldpose")
"""How a command line of ours begins; the rest are the arguments of `fieldpose`."""
_CAUGHT = ("SIGTERM", "SIGQUIT", "SIGHUP", "SIGCHLD", "SIGUSR2")


def can_fork() -> bool:
    """Whether a copy of this process could go on: on Linux, and only while it has a single thread."""
    return sys.platform.startswith("linux") and psutil.Process().num_threads() == 1


@contextmanager
def beside(*works: Callable[[], object]) -> Iterator[None]:
    """Have each of these done in a fork of this process that ends with it, while the context lasts, and wait for them.

    Only what they leave in files stays, and what goes wrong in them is lost. Nothing is done where this process cannot
    be forked.
    """
    pids = [_started(work) for work in works] if can_fork() else []
    try:
        yield
    finally:
        for pid in pids:
            os.waitpid(pid, 0)


def _started(work: Callable[[], object]) -> int:
    pid = os.fork()
    if pid == 0:
        try:
            die_with_parent()
            work()
        finally:
            os._exit(0)
    return pid


def become(arguments: Sequence[str], environment: Mapping[str, str]) -> NoReturn:
    """In a process just forked: be `fieldpose` with these arguments, and end with its exit code."""
    # Nothing that was inherited is collected: pages that are shared would be written to, and files of others closed.
    gc.freeze()
    for name in _CAUGHT:
        signal.signal(getattr(signal, name), signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.environ.clear()
    os.environ.update(environment)
    sys.argv = ["fieldpose", *arguments]
    setproctitle(" ".join(sys.argv))
    code = _code_of(arguments)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def _code_of(arguments: Sequence[str]) -> int:
    try:
        return int(importlib.import_module("fieldpose.deploy.cli").main(list(arguments)))
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
        return 1
