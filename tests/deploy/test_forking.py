"""Stages that are forked from their supervisor live and die as those that are executed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

from fieldpose.bus.protocol import wait_for
from fieldpose.bus.topics import Address
from fieldpose.bus.transport import ZenohBus
from fieldpose.deploy.processes.endpoints import free_port
from fieldpose.deploy.processes.forking import FIELDPOSE
from fieldpose.deploy.processes.supervision import Program, Supervisor
from fieldpose.errors import ProcessError

STAGES_ALONE = ("importlib:import_module", "fieldpose.deploy.commands.stage")
BESIDE = """
import sys
from pathlib import Path
from fieldpose.deploy.processes.forking import beside
done = Path(sys.argv[1])
with beside(done.touch, lambda: 1 / 0):
    inside = 1
print(inside, done.exists())
"""
SLEEP = "import time; time.sleep(60)"


def until(condition: Callable[[], object], timeout_s: float = 30.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(0.02)


def stage(name: str, *arguments: str) -> Program:
    return Program(name, [*FIELDPOSE, "stage", name, *arguments])


@pytest.fixture
def hub() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture
def bus(hub: str) -> Iterator[ZenohBus]:
    bus = ZenohBus(hub)
    yield bus
    bus.close()


def test_a_stage_that_is_killed_is_forked_again_and_ends_when_it_is_asked_to(
    tmp_path: Path, hub: str, bus: ZenohBus
) -> None:
    programs = [stage(name, "--connect", hub, "--open") for name in ("hub", "pnp")]
    with Supervisor(tmp_path, programs, STAGES_ALONE) as supervisor:
        wait_for(bus, Address(), ["pnp"], 60.0)
        first = supervisor.poll()["pnp"].pid
        if sys.platform.startswith("linux"):
            assert " ".join(psutil.Process(first).cmdline()).split()[:3] == ["fieldpose", "stage", "pnp"]
        os.kill(first, signal.SIGKILL)
        until(lambda: supervisor.poll() and supervisor.restarts == {"pnp": 1})
        wait_for(bus, Address(), ["pnp"], 60.0)
        assert supervisor.has_run("pnp")
        pids = [info.pid for info in supervisor.poll().values()]
        assert supervisor.stop(["pnp"], timeout_s=10.0)
        assert supervisor.stop(["hub"], timeout_s=10.0)
        assert {info.exit_code for info in supervisor.poll().values()} == {0}
    assert not any(psutil.pid_exists(pid) for pid in pids)


def test_a_users_mistake_ends_a_forked_stage_with_its_line(tmp_path: Path) -> None:
    with Supervisor(tmp_path, [stage("pnp", "--colour", "blue")], STAGES_ALONE) as supervisor:
        until(lambda: supervisor.poll().get("pnp") and supervisor.poll()["pnp"].given_up)
        with pytest.raises(ProcessError, match=r"^pnp: .*--colour"):
            supervisor.check(restart_limit=2)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="forks on Linux alone")
def test_work_beside_is_waited_for_and_its_failure_is_its_own(tmp_path: Path) -> None:
    said = subprocess.run([sys.executable, "-c", BESIDE, tmp_path / "done"], capture_output=True, text=True, timeout=60)
    assert (said.stdout, said.stderr) == ("1 True\n", "")


def test_other_commands_are_executed(tmp_path: Path) -> None:
    program = Program("a", [sys.executable, "-c", "import sys; print('fieldpose' in sys.modules, flush=True)"])
    with Supervisor(tmp_path, [program], STAGES_ALONE) as supervisor:
        until(lambda: supervisor.last_line("a") == "False")


def supervisors(folder: Path) -> list[psutil.Process]:
    return [child for child in psutil.Process().children() if str(folder) in " ".join(child.cmdline())]


def test_nothing_runs_while_it_is_prepared_and_that_can_be_ended(tmp_path: Path) -> None:
    prepare = ("builtins:exec", SLEEP)
    with Supervisor(tmp_path, [Program("a", [sys.executable, "-c", SLEEP])], prepare) as supervisor:
        assert supervisor.poll() == supervisor.check(restart_limit=0) == {}
        assert not supervisor.has_run("a")
        # While it gives itself a title its command line is empty for a moment.
        found: list[psutil.Process] = []
        until(lambda: found or found.extend(supervisors(tmp_path)))
    (daemon,) = found
    assert not daemon.is_running()


def test_what_goes_wrong_while_it_is_prepared_is_told(tmp_path: Path) -> None:
    with (
        Supervisor(tmp_path, [], ("builtins:exec", "1 / 0")) as supervisor,
        pytest.raises(ProcessError, match="supervisord cannot start: ZeroDivisionError"),
    ):
        until(lambda: supervisor.poll())
