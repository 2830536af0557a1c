"""Starting processes, restarting those that die, and ending all of them, by supervisord (supervisord.org)."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import xmlrpc.client
from collections.abc import Callable, Container, Sequence
from contextlib import suppress
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path
from types import TracebackType
from typing import Any

from fieldpose.deploy.graph import thread_environment
from fieldpose.deploy.processes.configuration import COMMENTS, USER_ERROR, Program, configuration
from fieldpose.deploy.processes.lifeline import PARENT, TEMPORARY
from fieldpose.deploy.processes.rpc import Transport
from fieldpose.deploy.processes.sessions import end_session
from fieldpose.errors import ProcessError

__all__ = ["USER_ERROR", "ProcessInfo", "Program", "Supervisor"]

_LONGEST_SOCKET_PATH = 100
_ANSWER_S = 10.0
_HUNG_S = 10.0
_CALL_S = 1.0
"""A call that takes longer is made again, so that whoever waits for it can look after other things."""
_FINISH_S = 5.0
"""How long processes may take that end because supervisord has: a recorder finishes its file."""
_END_S = 2.0
_POLL_S = 0.02
_SUPERVISORD = (sys.executable, "-P", "-m", "fieldpose.deploy.processes.supervisord")
_RESTING = ("STOPPED", "EXITED", "FATAL")


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
        return self.state == "FATAL" or (self.state == "EXITED" and self.failed)

    @property
    def failed(self) -> bool:
        """It has ended with USER_ERROR, by itself or when it was stopped."""
        return self.state in ("EXITED", "STOPPED") and self.exit_code == USER_ERROR


class Supervisor:
    """Runs programs while the context lasts; `folder` gets the configuration, a socket, and a log of each.

    prepare: a function as "module:name" and its arguments, called by supervisord before it starts anything; programs
    that begin with `forking.FIELDPOSE` are then forked from it. temporary: where this process is killed, so that it
    cannot remove the folder, supervisord does.

    A program that ends with USER_ERROR stays down, and so does one that has done its work; any other end brings it
    back. All of them end with this process, even if it is killed. Raises ProcessError where supervisord does not
    come up.
    """

    def __init__(
        self, folder: Path, programs: Sequence[Program], prepare: Sequence[str] = (), temporary: bool = False
    ) -> None:
        self.restarts: dict[str, int] = {}
        self._folder = folder = folder.resolve()
        self._programs, self._prepare, self._answered = programs, prepare, False
        self._flags = [TEMPORARY] if temporary else []
        self._socket = folder / "supervisor.sock"
        self._pids: dict[str, int] = {}
        self._infos: dict[str, ProcessInfo] = {}
        self._heard_s = time.monotonic()
        self._daemon: subprocess.Popen[bytes] | None = None
        self._transport: Any = Transport(self._socket, _CALL_S)
        self._rpc: Any = xmlrpc.client.ServerProxy("http://127.0.0.1", self._transport).supervisor

    def __enter__(self) -> Supervisor:
        if len(str(self._socket)) > _LONGEST_SOCKET_PATH:
            raise ProcessError(f"{self._folder}: too long a path for a socket; set TMPDIR to a shorter one")
        config = self._folder / "supervisord.conf"
        config.write_text(configuration(self._programs), encoding="utf-8")
        with (self._folder / "supervisord.out").open("wb") as output:
            self._daemon = subprocess.Popen(
                [*_SUPERVISORD, *self._flags, str(config), *self._prepare],
                stdin=subprocess.DEVNULL,
                stdout=output,
                cwd=self._folder,
                stderr=subprocess.STDOUT,
                # The libraries that it imports are to start no threads.
                env={**os.environ, **thread_environment(1), **COMMENTS, PARENT: str(os.getpid())},
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
        """The state of each process now, of none while they are prepared; also counts who came back since.

        What was said last where supervisord is slow to answer; raises ProcessError where it is gone, or hung.
        """
        if not self._answers():
            return {}
        entries = self._call(self._rpc.getAllProcessInfo)
        if entries is None:
            return self._infos
        infos = self._infos = {
            entry["name"]: ProcessInfo(entry["statename"], entry["pid"], entry["exitstatus"]) for entry in entries
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

    def kill(self, name: str) -> None:
        """End a process at once; it comes back, as after any other end that nobody asked for."""
        self._call(self._rpc.signalProcess, name, "KILL")

    def stop(self, names: Sequence[str], timeout_s: float, hurry: Callable[[], bool] = lambda: False) -> bool:
        """End processes, all at the same time; those that are still up after the timeout, or in a hurry, are killed.

        Returns whether every one of them ended by itself.
        """
        try:
            return self._stop(names, time.monotonic() + timeout_s, hurry)
        except ProcessError:
            return False

    def failure(self, name: str) -> str | None:
        """The last line of a process that has ended with USER_ERROR, or does not stay up; None of any other."""
        info = self._infos.get(name)
        return self.last_line(name) if info is not None and (info.failed or info.given_up) else None

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

    def _stop(self, names: Sequence[str], deadline: float, hurry: Callable[[], bool]) -> bool:
        for name in self._up(names):
            self._call(self._rpc.stopProcess, name, False)
        while (up := self._up(names)) and time.monotonic() < deadline and not hurry():
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
        """What supervisord answers; None where it refuses, as for a process that has just ended, or is slow."""
        try:
            answer = method(*arguments)
        except xmlrpc.client.Fault:
            answer = None
        except TimeoutError:
            self._transport.close()
            silent_s = time.monotonic() - self._heard_s
            if silent_s > _HUNG_S:
                raise ProcessError(
                    f"supervisord, which looks after the processes, is hung: no answer for {silent_s:.0f} s; the run is"
                    " over"
                ) from None
            return None
        except (OSError, HTTPException, xmlrpc.client.ProtocolError) as error:
            self._transport.close()  # it would go on with a broken connection
            raise ProcessError(self._gone(error)) from error
        self._heard_s = time.monotonic()
        return answer

    def _gone(self, error: Exception) -> str:
        code = self._ended() if self._answered else None
        if code is None:
            return f"the supervisor of the processes does not answer: {error}"
        how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with code {code}"
        return f"supervisord, which looks after the processes, {how}; the run is over"

    def _ended(self) -> int | None:
        """The exit code of supervisord; its sockets are gone a moment before it is."""
        assert self._daemon is not None
        with suppress(subprocess.TimeoutExpired):
            self._daemon.wait(_CALL_S)
        return self._daemon.returncode

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
                self._answered = self._call(self._rpc.getState) is not None
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
        if not nothing_left:
            end_session(self._daemon.pid, _FINISH_S)
