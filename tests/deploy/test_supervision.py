"""Processes are started, brought back when they die, and ended with whoever started them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest

from fieldpose.deploy.processes.supervision import USER_ERROR, Program, Supervisor
from fieldpose.errors import ProcessError

SLEEP = "import time; print('up', flush=True); time.sleep(60)"
STUBBORN = f"import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); {SLEEP}"


def python(name: str, code: str, **options: object) -> Program:
    return Program(name, [sys.executable, "-c", code], **options)  # type: ignore[arg-type]


def until(condition: Callable[[], object], timeout_s: float = 10.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(0.02)


def test_one_that_is_killed_comes_back_and_is_counted(tmp_path: Path) -> None:
    with Supervisor(tmp_path, [python("a", SLEEP), python("b", SLEEP)]) as supervisor:
        first = supervisor.poll()
        os.kill(first["a"].pid, signal.SIGKILL)
        until(lambda: supervisor.poll() and supervisor.restarts)
        second = supervisor.check(restart_limit=1)
        assert second["a"].pid not in (0, first["a"].pid)
        assert second["b"].pid == first["b"].pid
        assert supervisor.restarts == {"a": 1}
    assert not psutil.pid_exists(second["a"].pid)
    assert not psutil.pid_exists(second["b"].pid)


def test_one_that_dies_again_and_again_is_an_error_with_its_last_words(tmp_path: Path) -> None:
    program = python("a", "import sys; print('out of cheese'); sys.exit(7)")
    with (
        Supervisor(tmp_path, [program]) as supervisor,
        pytest.raises(ProcessError, match="a does not stay up: out of cheese; its log is"),
    ):
        until(lambda: supervisor.check(restart_limit=2) is None)


def test_a_users_mistake_is_told_at_once_and_not_tried_again(tmp_path: Path) -> None:
    program = python("a", f"import sys; print('fieldpose: no such thing'); sys.exit({USER_ERROR})")
    with Supervisor(tmp_path, [program]) as supervisor:
        until(lambda: supervisor.poll()["a"].given_up)
        with pytest.raises(ProcessError, match=r"^a: no such thing$"):
            supervisor.check(restart_limit=2)
        assert supervisor.check(restart_limit=2, spared=("a",))["a"].given_up
        assert supervisor.restarts == {}


def test_only_one_that_may_end_stays_down_after_its_work(tmp_path: Path) -> None:
    programs = [python("camera", "pass", ends=True), python("stage", "pass")]
    with Supervisor(tmp_path, programs) as supervisor:
        until(lambda: supervisor.poll()["camera"].finished)
        until(lambda: supervisor.poll() and supervisor.restarts.get("stage", 0) >= 2)
        assert "camera" not in supervisor.restarts


def test_those_that_do_not_listen_are_killed_after_the_timeout(tmp_path: Path) -> None:
    programs = [python("good", SLEEP), python("bad", STUBBORN, stop_s=300.0)]
    with Supervisor(tmp_path, programs) as supervisor:
        until(lambda: all("up" in supervisor.last_line(name) for name in ("good", "bad")))
        pid = supervisor.poll()["bad"].pid
        began = time.monotonic()
        assert supervisor.stop(["good"], timeout_s=30.0)
        assert not supervisor.stop(["bad"], timeout_s=0.3)
        assert time.monotonic() - began < 150.0
        until(lambda: not psutil.pid_exists(pid))


def test_who_is_in_a_hurry_waits_for_nobody(tmp_path: Path) -> None:
    with Supervisor(tmp_path, [python("bad", STUBBORN, stop_s=60.0)]) as supervisor:
        until(lambda: "up" in supervisor.last_line("bad"))
        pid = supervisor.poll()["bad"].pid
        asked: list[None] = []
        assert not supervisor.stop(["bad"], timeout_s=60.0, hurry=lambda: asked.append(None) or len(asked) > 3)
        until(lambda: not psutil.pid_exists(pid))
    assert len(asked) == 4


def test_what_ended_with_a_users_mistake_is_told_also_of_those_that_were_stopped(tmp_path: Path) -> None:
    failing = (
        "import signal, sys;"
        f"signal.signal(signal.SIGTERM, lambda *_: print('fieldpose: no room') or sys.exit({USER_ERROR})); {SLEEP}"
    )
    programs = [
        python("failing", failing),
        python("good", SLEEP),
        python("mistaken", f"raise SystemExit({USER_ERROR})"),
    ]
    with Supervisor(tmp_path, programs) as supervisor:
        until(lambda: all("up" in supervisor.last_line(name) for name in ("failing", "good")))
        until(lambda: supervisor.poll()["mistaken"].given_up)
        assert supervisor.failure("failing") is None
        assert supervisor.stop(["failing", "good"], timeout_s=20.0)
        told = [supervisor.failure(name) for name in ("failing", "good", "mistaken")]
    assert told == ["no room", None, "it said nothing"]


def test_all_end_when_whoever_started_them_is_killed_and_no_temporary_folder_is_left(tmp_path: Path) -> None:
    folder = tmp_path / "temporary"
    folder.mkdir()
    code = f"""
import sys, time
from pathlib import Path
from fieldpose.deploy.processes.supervision import Program, Supervisor
if __name__ == "__main__":
    programs = [Program("a", [sys.executable, "-c", {SLEEP!r}])]
    with Supervisor(Path({str(folder)!r}), programs, temporary=True) as supervisor:
        while not supervisor.poll()["a"].pid:
            time.sleep(0.02)
        print(supervisor.poll()["a"].pid, flush=True)
        time.sleep(60)
"""
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    until(lambda: not psutil.pid_exists(child))
    until(lambda: not folder.exists())


def test_the_environment_reaches_the_process_and_odd_characters_survive(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "1 % #1 ;2"
    folder.mkdir()
    program = Program(
        "a",
        [sys.executable, "-c", "import os, sys; print(os.environ['X'], sys.argv[1], os.getcwd())", "50%; 'x y' #3 ;4"],
        {"X": "a%b"},
    )
    monkeypatch.chdir(folder)
    with Supervisor(folder, [program]) as supervisor:
        until(lambda: supervisor.last_line("a").endswith(str(folder)))  # its pieces may be written one by one
        assert supervisor.last_line("a") == f"a%b 50%; 'x y' #3 ;4 {folder}"


def test_a_folder_too_deep_for_a_socket_is_told(tmp_path: Path) -> None:
    folder = tmp_path / ("deep" * 30)
    folder.mkdir()
    with pytest.raises(ProcessError, match="too long a path for a socket"), Supervisor(folder, []):
        pass


def of_session(tmp_path: Path) -> int:
    return int((tmp_path / "supervisord.pid").read_text())


def is_running(pid: int) -> bool:
    return psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE


def signalled_in_the_end(folder: Path, programs: list[Program], number: signal.Signals) -> tuple[str, list[int]]:
    """What is said where supervisord gets a signal while its programs run, and their process ids."""
    pids: list[int] = []

    def run() -> None:
        with Supervisor(folder, programs) as supervisor:
            until(lambda: all("up" in supervisor.last_line(program.name) for program in programs))
            processes = supervisor.poll()
            pids.extend(process.pid for process in processes.values())
            os.kill(processes[programs[-1].name].pid, signal.SIGSTOP)
            os.kill(of_session(folder), number)
            until(lambda: not supervisor.poll())

    with pytest.raises(ProcessError) as raised:
        run()
    return str(raised.value), pids


def test_where_the_supervisor_is_killed_one_line_tells_it_and_nothing_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fieldpose.deploy.processes.supervision._FINISH_S", 0.5)
    programs = [python("good", SLEEP), python("bad", STUBBORN), python("stopped", SLEEP)]
    said, pids = signalled_in_the_end(tmp_path, programs, signal.SIGKILL)
    assert said == "supervisord, which looks after the processes, was killed by SIGKILL; the run is over"
    assert len(pids) == 3
    assert not any(map(is_running, pids))


def test_a_supervisor_that_is_stopped_for_good_is_no_longer_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, seconds in (("_CALL_S", 0.1), ("_HUNG_S", 0.5), ("_FINISH_S", 0.5)):
        monkeypatch.setattr(f"fieldpose.deploy.processes.supervision.{name}", seconds)
    said, pids = signalled_in_the_end(tmp_path, [python("a", SLEEP)], signal.SIGSTOP)
    assert said.startswith("supervisord, which looks after the processes, is hung: no answer for ")
    assert not any(map(is_running, pids))


def test_a_supervisor_that_is_stopped_for_a_while_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fieldpose.deploy.processes.supervision._CALL_S", 0.1)
    with Supervisor(tmp_path, [python("a", SLEEP)]) as supervisor:
        until(lambda: supervisor.poll()["a"].state == "RUNNING")
        before = supervisor.poll()
        os.kill(of_session(tmp_path), signal.SIGSTOP)
        assert supervisor.poll() == before
        os.kill(of_session(tmp_path), signal.SIGCONT)
        supervisor.kill("a")
        until(lambda: supervisor.poll()["a"].pid not in (0, before["a"].pid))


def test_programs_are_started_in_the_order_given(tmp_path: Path) -> None:
    code = "import sys, time; sys.stdout.write('up'); sys.stdout.flush(); time.sleep(60)"
    with Supervisor(tmp_path, [python(name, code) for name in "cab"]) as supervisor:
        until(lambda: all(process.pid for process in supervisor.poll().values()) and supervisor.poll())
        pids = {name: process.pid for name, process in supervisor.poll().items()}
    assert sorted(pids, key=lambda name: pids[name]) == list("cab")
