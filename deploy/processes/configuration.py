"""Programs to be kept up, and the file by which supervisord learns of them."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

COMMENTS = {"FIELDPOSE_HASH": "#", "FIELDPOSE_SEMICOLON": ";"}
"""To be in supervisord's environment: after a space these begin a comment in its file, wherever they stand."""
USER_ERROR = 2
"""The exit code of a process that was given something that only the user can mend."""


@dataclass(frozen=True)
class Program:
    """A process to keep up: its command line, what is added to its environment, how long it may take to stop.

    `ends`: exit code 0 means that it has done its work; without it, it is brought back after that too.
    """

    name: str
    command: Sequence[str]
    environment: Mapping[str, str] = field(default_factory=dict)
    stop_s: float = 2.0
    ends: bool = False


def configuration(programs: Sequence[Program]) -> str:
    """The file that supervisord reads, which starts the programs in this order.

    Its own files are relative to the folder that it runs in.
    """
    values: dict[str, dict[str, object]] = {
        "unix_http_server": {"file": "supervisor.sock", "chmod": "0700"},
        "supervisord": {
            "nodaemon": "true",
            "silent": "true",
            "logfile": "supervisord.log",
            "pidfile": "supervisord.pid",
            "childlogdir": ".",
        },
        "rpcinterface:supervisor": {
            "supervisor.rpcinterface_factory": "supervisor.rpcinterface:make_main_rpcinterface"
        },
    }
    for place, program in enumerate(programs):
        values[f"program:{program.name}"] = {**_program(program), "priority": place}
    return "\n".join(_section(name, content) for name, content in values.items())


def _program(program: Program) -> dict[str, object]:
    environment = ",".join(f'{name}="{value}"' for name, value in program.environment.items())
    return {
        "command": shlex.join(program.command),
        "environment": environment,
        "directory": Path.cwd(),
        "autorestart": "unexpected",
        "exitcodes": f"0,{USER_ERROR}" if program.ends else USER_ERROR,
        # Up as soon as it is started: a bad start is told by the exit code, and `check` counts the others.
        "startsecs": 0,
        "startretries": 3,
        "stopwaitsecs": max(1, round(program.stop_s)),
        "stopasgroup": "true",
        "killasgroup": "true",
        "redirect_stderr": "true",
        "stdout_logfile": f"{program.name}.log",
        "stdout_logfile_maxbytes": "10MB",
        "stdout_logfile_backups": 1,
    }


def _section(name: str, content: Mapping[str, object]) -> str:
    lines = [f"{key}={_escaped(str(value))}" for key, value in content.items() if value != ""]
    return "\n".join([f"[{name}]", *lines, ""])


def _escaped(value: str) -> str:
    escaped = value.replace("%", "%%")
    for name, sign in COMMENTS.items():
        escaped = escaped.replace(sign, f"%(ENV_{name})s")
    return escaped
