"""Stages forked from a process that has already imported what they need: no imports, and their memory is shared."""

from __future__ import annotations

import gc
import importlib
import os
import signal
import sys
import traceback
from collections.abc import Mapping, Sequence
from typing import NoReturn

import psutil
from setproctitle import setproctitle

FIELDPOSE = (sys.executable, "-P", "-m", "fieldpose")
"""How a command line of ours begins; the rest are the arguments of `fieldpose`."""
_CAUGHT = ("SIGTERM", "SIGQUIT", "SIGHUP", "SIGCHLD", "SIGUSR2")


def can_fork() -> bool:
    """Whether a copy of this process could go on: on Linux, and only while it has a single thread."""
    return sys.platform.startswith("linux") and psutil.Process().num_threads() == 1


def become(arguments: Sequence[str], environment: Mapping[str, str]) -> NoReturn:
    """In a process just forked: be `fieldpose` with these arguments, and end with its exit code."""
    # What was inherited is never collected: that would write to, and so copy, every page that is shared.
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
