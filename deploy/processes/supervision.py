"""Starting processes, restarting those that die, and ending all of them, by supervisord (supervisord.org)."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import time
import xmlrpc.client
from collections.abc import Callable, Container, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from http.client import HTTPException
from pathlib import Path
from types import TracebackType
from typing import Any

from supervisor.xmlrpc import SupervisorTransport

from fieldpose.deploy.graph import thread_environment
from fieldpose.deploy.processes.lifeline import PARENT
from fieldpose.errors import ProcessError

USER_ERROR = 2
"""The exit code of a process that was given something that only the user can mend."""
_LONGEST_SOCKET_PATH = 100
_ANSWER_S = 10.0
_END_S = 2.0
_POLL_S = 0.02
_SUPERVISORD = (sys.executable, "-P", "-m", "fieldpose.deploy.processes.supervisord")
_RESTING = ("STOPPED", "EXITED", "FATAL")


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


@dataclass(frozen=True)
class ProcessInfo:
    """A process as supervisord sees it; `state` is its word: STARTING, RUNNING, BACKOFF, EXITED, FATAL, STOPPED."""

    state: str
    pid: int
    exit_code: int

    @property
    def finished(self) -> bool:
        """It has ended by itself, with its work done."""
        return self.state == "EXITED" and self.exit_code == 0

    @property
    def given_up(self) -> bool:
        """It has ended, and will not come back."""
        return self.state == "FATAL" or (self.state == "EXITED" and self.exit_code == USER_ERROR)


class Supervisor:
    """Runs programs while the context lasts; `folder` gets the configuration, a socket, and a log of each.

    prepare: a function as "module:name" and its arguments, called by supervisord before it starts anything; programs
    that begin with `forking.FIELDPOSE` are then forked from it.

    A program that ends with USER_ERROR stays down, and so does one that has done its work; any other end brings it
    back. All of them end with this process, even if it is killed. Raises ProcessError where supervisord does not
    come up.
    """

    def __init__(self, folder: Path, programs: Sequence[Program], prepare: Sequence[str] = ()) -> None:
        self.restarts: dict[str, int] = {}
        self._folder = folder = folder.resolve()
        self._programs, self._prepare, self._answered = programs, prepare, False
        self._socket = folder / "supervisor.sock"
        self._pids: dict[str, int] = {}
        self._daemon: subprocess.Popen[bytes] | None = None
        self._transport: Any = SupervisorTransport(None, None, f"unix://{self._socket}")
        self._rpc: Any = xmlrpc.client.ServerProxy("http://127.0.0.1", self._transport).supervisor

    def __enter__(self) -> Supervisor:
        if len(str(self._socket)) > _LONGEST_SOCKET_PATH:
            raise ProcessError(f"{self._folder}: too long a path for a socket; set TMPDIR to a shorter one")
        config = self._folder / "supervisord.conf"
        config.write_text(configuration(self._programs), encoding="utf-8")
        with (self._folder / "supervisord.out").open("wb") as output:
            self._daemon = subprocess.Popen(
                [*_SUPERVISORD, str(config), *self._prepare],
                stdin=subprocess.DEVNULL,
                stdout=output,
                cwd=self._folder,
                stderr=subprocess.STDOUT,
                # The libraries that it imports are to start no threads.
                env={**os.environ, **thread_environment(1), PARENT: str(os.getpid())},
                # A Ctrl-C at the terminal is for the command, which then stops the processes in order.
                start_new_session=True,
            )
        if not self._prepare:
            self._wait_for_answer()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        ended = self.stop([program.name for program in self._programs], timeout_s=1.0)
        self._end_daemon(nothing_left=ended)

    def poll(self) -> dict[str, ProcessInfo]:
        """The state of each process now, of none while they are prepared; also counts who came back since."""
        if not self._answers():
            return {}
        infos = {
            entry["name"]: ProcessInfo(entry["statename"], entry["pid"], entry["exitstatus"])
            for entry in self._call(self._rpc.getAllProcessInfo) or ()
        }
        for name, info in infos.items():
            before = self._pids.get(name, 0)
            if info.pid and before and info.pid != before:
                self.restarts[name] = self.restarts.get(name, 0) + 1
            self._pids[name] = info.pid or before
        return infos

    def has_run(self, name: str) -> bool:
        """Whether a process has been started, as far as `poll` has told."""
        return self._pids.get(name, 0) > 0

    def check(self, restart_limit: int, spared: Container[str] = ()) -> dict[str, ProcessInfo]:
        """`poll`, raising ProcessError with the last line of its log for a process that does not stay up.

        spared: those without which the others go on.
        """
        infos = self.poll()
        for name, info in infos.items():
            if name not in spared and (info.given_up or self.restarts.get(name, 0) > restart_limit):
                raise ProcessError(self._why(name, info))
        return infos

    def stop(self, names: Sequence[str], timeout_s: float) -> bool:
        """End processes, all at the same time; those that are still up after the timeout are killed.

        Returns whether every one of them ended by itself.
        """
        try:
            return self._stop(names, time.monotonic() + timeout_s)
        except ProcessError:
            return False

    def last_line(self, name: str) -> str:
        """What a process said last, without the name of the program in front."""
        try:
            lines = self.log(name).read_text(encoding="utf-8", errors="replace").split("\n")
        except OSError:
            lines = []
        said = [line.strip() for line in lines if line.strip()]
        return said[-1].removeprefix("fieldpose: ") if said else "it said nothing"

    def log(self, name: str) -> Path:
        """The file with what a process says on stdout and stderr."""
        return self._folder / f"{name}.log"

    def _stop(self, names: Sequence[str], deadline: float) -> bool:
        for name in self._up(names):
            self._call(self._rpc.stopProcess, name, False)
        while (up := self._up(names)) and time.monotonic() < deadline:
            time.sleep(_POLL_S)
        for name in up:
            self._call(self._rpc.signalProcess, name, "KILL")
        return not up

    def _up(self, names: Sequence[str]) -> list[str]:
        infos = self.poll()
        return [name for name in names if name in infos and infos[name].state not in _RESTING]

    def _why(self, name: str, info: ProcessInfo) -> str:
        if info.state == "EXITED" and info.exit_code == USER_ERROR:
            return f"{name}: {self.last_line(name)}"
        return f"{name} does not stay up: {self.last_line(name)}; its log is {self.log(name)}"

    def _call(self, method: Callable[..., Any], *arguments: Any) -> Any:
        """What supervisord answers; None where it refuses, as for a process that has just ended by itself."""
        try:
            return method(*arguments)
        except xmlrpc.client.Fault:
            return None
        except (OSError, HTTPException, xmlrpc.client.ProtocolError) as error:
            self._transport.close()  # it would go on with a broken connection
            raise ProcessError(f"the supervisor of the processes does not answer: {error}") from error

    def _wait_for_answer(self) -> None:
        deadline = time.monotonic() + _ANSWER_S
        try:
            while not self._answers():
                if time.monotonic() > deadline:
                    raise ProcessError(f"supervisord cannot start: {self._last_words()}")
                time.sleep(_POLL_S)
        except BaseException:
            self._end_daemon(nothing_left=False)
            raise

    def _answers(self) -> bool:
        """Whether supervisord has come up: not while it prepares."""
        if not self._answered:
            if self._daemon is None or self._daemon.poll() is not None:
                raise ProcessError(f"supervisord cannot start: {self._last_words()}")
            with suppress(ProcessError):
                self._call(self._rpc.getState)
                self._answered = True
        return self._answered

    def _last_words(self) -> str:
        text = (self._folder / "supervisord.out").read_text(errors="replace").strip()
        return text.splitlines()[-1] if text else "it said nothing"

    def _end_daemon(self, nothing_left: bool) -> None:
        if self._daemon is None:
            return
        # It takes a second to end by itself.
        self._daemon.send_signal(signal.SIGKILL if nothing_left else signal.SIGTERM)
        try:
            self._daemon.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._daemon.kill()
            self._daemon.wait()


def configuration(programs: Sequence[Program]) -> str:
    """The file that supervisord reads; its own files are relative to the folder that it runs in."""
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
    for program in programs:
        values[f"program:{program.name}"] = _program(program)
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
    # A percent sign begins an expansion in these files, a semicolon after a space a comment.
    lines = [f"{key}={str(value).replace('%', '%%')}" for key, value in content.items() if value != ""]
    return "\n".join([f"[{name}]", *lines, ""])
