"""The supervisor of a pipeline's processes as a program: supervisord, which ends with its parent and forks the stages.

Imports would take every stage a second or more and 200 MB. Here they are made once, before anything is started, and
each `fieldpose …` is a fork of this process; other commands, and all where forks are no use, are executed as ever.
"""

from __future__ import annotations

import gc
import importlib
import os
import shutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from setproctitle import setproctitle
from supervisor import supervisord
from supervisor.options import ServerOptions

from fieldpose.bus.segments import removed_orphans
from fieldpose.deploy.processes.forking import FIELDPOSE, become, can_fork
from fieldpose.deploy.processes.lifeline import PARENT, TEMPORARY, die_with_parent


class ForkingOptions(ServerOptions):
    """supervisord's hooks into the operating system; `execve` is called in the process just forked."""

    forks = False

    def execve(self, filename: str, argv: Sequence[str], env: Mapping[str, str]) -> None:
        if self.forks and tuple(argv[: len(FIELDPOSE)]) == FIELDPOSE:
            become(argv[len(FIELDPOSE) :], env)
        super().execve(filename, argv, env)


def main(config: str, prepare: Sequence[str], temporary: bool = False) -> None:
    """Serve a configuration; `prepare` is a function, as "module:name", and what it is called with before.

    temporary: where the parent was killed in the meantime, what it would have removed is removed here.
    """
    die_with_parent()
    parent = os.getppid()
    # It finds the place of the title only while the environment is as it was.
    setproctitle(f"fieldpose supervisord -c {config}")
    # For this process alone: its children have another parent.
    os.environ.pop(PARENT, None)
    options = ForkingOptions()
    if prepare:
        _call(*prepare)
        options.forks = can_fork()
    options.realize(["-c", config], doc=supervisord.__doc__)
    options.first, options.test = True, False
    supervisord.go(options)
    options.close_httpservers()
    options.close_logger()
    if temporary and os.getppid() != parent:
        shutil.rmtree(Path(config).parent, ignore_errors=True)
        with removed_orphans():
            pass


def _call(function: str, *arguments: str) -> None:
    """Call a function, and leave what it makes alone for ever: looking for garbage takes as long as many an import."""
    gc.disable()
    module, name = function.split(":")
    getattr(importlib.import_module(module), name)(*arguments)
    gc.freeze()
    gc.enable()


if __name__ == "__main__":
    arguments = [argument for argument in sys.argv[1:] if argument != TEMPORARY]
    main(arguments[0], arguments[1:], temporary=TEMPORARY in sys.argv[1:])
