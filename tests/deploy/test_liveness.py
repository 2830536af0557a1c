"""A process whose main loop says nothing more is hung, unless it works, has just begun, or nobody has looked."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

import msgspec
import psutil
import pytest
from support.bus_samples import every_message

from fieldpose.bus.topics import STATS
from fieldpose.deploy.processes.liveness import SILENT_S, START_S, STILL_S, Life, Liveness

SLEEPS = "import time; time.sleep(600)"
RUNS = "while True: pass"
STEP_S = 0.5


@contextmanager
def process(code: str) -> Iterator[psutil.Process]:
    started = subprocess.Popen([sys.executable, "-c", f"print(flush=True); {code}"], stdout=subprocess.PIPE)
    assert started.stdout is not None
    started.stdout.readline()
    try:
        yield psutil.Process(started.pid)
    finally:
        started.kill()
        started.wait()
        started.stdout.close()


def until(one: psutil.Process, status: str) -> None:
    deadline = time.monotonic() + 10.0
    while one.status() != status:
        assert time.monotonic() < deadline, one.status()
        time.sleep(0.01)


class Watch:
    """Looks at one process, a heartbeat's time further with each look."""

    def __init__(self, pid: int) -> None:
        self.liveness = Liveness()
        self.pid, self.now_s, self.beats = pid, 100.0, 0

    def look(self, beats: bool = False, ready: bool = True, loops: bool = True, step_s: float = STEP_S) -> bool:
        self.beats += beats
        self.now_s += step_s
        life = Life("a", self.pid, self.beats or None, ready and self.beats > 0, loops)
        return self.liveness.look([life], self.now_s) == ["a"]

    def silence_s(self, limit_s: float, **how: bool) -> float | None:
        """How long it is silent until it is found to be hung."""
        began_s = self.now_s
        while self.now_s - began_s < limit_s:
            if self.look(**how):
                return self.now_s - began_s
        return None


def begun(pid: int) -> Watch:
    watch = Watch(pid)
    assert not watch.look()
    assert not watch.look(beats=True)
    return watch


def test_a_main_loop_that_waits_for_ever_is_hung_after_six_heartbeats_and_is_told_once() -> None:
    with process(SLEEPS) as one:
        until(one, psutil.STATUS_SLEEPING)
        watch = begun(one.pid)
        assert watch.silence_s(SILENT_S) == pytest.approx(STILL_S, abs=2 * STEP_S)
        assert watch.silence_s(SILENT_S) is None


def test_one_that_runs_may_be_at_a_long_call() -> None:
    with process(RUNS) as one:
        watch = begun(one.pid)
        assert watch.silence_s(2 * SILENT_S) == pytest.approx(SILENT_S, abs=2 * STEP_S)


def test_one_that_is_stopped_is_hung_though_it_has_not_begun_or_has_no_loop() -> None:
    with process(SLEEPS) as one:
        one.suspend()
        until(one, psutil.STATUS_STOPPED)
        assert Watch(one.pid).silence_s(SILENT_S, ready=False) == pytest.approx(STILL_S, abs=2 * STEP_S)
        assert begun(one.pid).silence_s(SILENT_S, loops=False) == pytest.approx(STILL_S, abs=2 * STEP_S)


def test_one_that_has_not_begun_may_load_for_long_and_one_without_a_loop_may_be_still() -> None:
    with process(SLEEPS) as one:
        until(one, psutil.STATUS_SLEEPING)
        assert Watch(one.pid).silence_s(START_S - 1.0, ready=False) is None
        assert begun(one.pid).silence_s(SILENT_S - 1.0, loops=False) is None


def test_a_heartbeat_takes_the_silence_back() -> None:
    with process(SLEEPS) as one:
        watch = begun(one.pid)
        for _ in range(5):
            assert watch.silence_s(STILL_S - 1.0) is None
            assert not watch.look(beats=True)


def test_time_in_which_nobody_looked_does_not_count() -> None:
    with process(SLEEPS) as one:
        watch = begun(one.pid)
        assert not watch.look(step_s=3600.0)
        assert not watch.look(step_s=3600.0)
        assert not watch.look(beats=True)


def test_faults_tell_who_ended_who_was_hung_and_when_each_was_back() -> None:
    with process(SLEEPS) as first, process(SLEEPS) as second, process(SLEEPS) as third:
        until(first, psutil.STATUS_SLEEPING)
        watch = begun(first.pid)
        watch.pid = second.pid
        assert not watch.look()
        assert [(fault.what, fault.away_s) for fault in watch.liveness.faults] == [("ended", None)]
        assert not watch.look(beats=True)
        (ended,) = watch.liveness.faults
        assert ended.away_s is not None
        assert ended.away_s >= 0
        until(second, psutil.STATUS_SLEEPING)
        assert watch.silence_s(SILENT_S) is not None
        watch.pid = third.pid
        assert not watch.look()
        assert [fault.what for fault in watch.liveness.faults] == ["ended", "hung"]
        assert watch.liveness.hung == ["a"]
        assert watch.liveness.faults[1].back_ns is None


def test_a_stage_of_several_pipelines_is_ready_once_it_has_said_so_in_each() -> None:
    def said(*ready: bool) -> Life:
        stats = [msgspec.structs.replace(every_message()[STATS], ready=one) for one in ready]
        return Life.by_stats("rendering", 1, stats)

    assert said(True, True).ready
    assert not said(False, True).ready
    assert not said().ready
    assert said().heartbeat is None


def test_where_the_system_does_not_tell_switches_only_the_long_silence_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(self: psutil.Process) -> object:
        raise NotImplementedError

    monkeypatch.setattr(psutil.Process, "num_ctx_switches", unknown)
    with process(SLEEPS) as one:
        assert begun(one.pid).silence_s(SILENT_S + 1.0) == pytest.approx(SILENT_S, abs=2 * STEP_S)


def test_one_that_is_gone_is_left_to_its_supervisor() -> None:
    with process(SLEEPS) as one:
        watch = begun(one.pid)
        os.kill(one.pid, signal.SIGKILL)
        until(one, psutil.STATUS_ZOMBIE)
        assert watch.silence_s(SILENT_S - 1.0) is None
