"""Runs inputs through a reader in a child process that is watched for hangs, crashes and memory, and keeps what fails.

A finding is anything but success or the named error in one line.
"""

from __future__ import annotations

import mmap
import os
import random
import resource
import shutil
import signal
import struct
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import psutil

from fieldpose.deploy.fuzzing.mutations import mutated
from fieldpose.deploy.fuzzing.reach import Reach
from fieldpose.errors import FieldposeError

Input = dict[str, bytes]
"""Files by their names in a folder."""
_POLL_S = 0.05
_MOST_KEPT = 2000
_PLAIN = 0.85
_SAME = 3
"""Findings of one kind that are kept."""
_ADDRESS_FACTOR = 4
"""Of the bound on memory: address space, much of which is reserved and never used."""


@dataclass(frozen=True)
class Target:
    """Something that reads bytes from outside.

    read: reads the files of a folder; seeds: right inputs, made in a folder of their own; errors: what may be raised.
    """

    name: str
    read: Callable[[Path], object]
    seeds: Callable[[Path], list[Input]]
    errors: tuple[type[FieldposeError], ...]


@dataclass(frozen=True)
class Bounds:
    """What an input may take: seconds of CPU time, and MB above what the process has at its start."""

    seconds: float = 10.0
    memory_mb: int = 2048


class Finding(msgspec.Struct, frozen=True):
    """An input, and what became of it."""

    target: str
    kind: str
    detail: str
    files: dict[str, bytes]


@dataclass
class Result:
    """Of a campaign: how many inputs were read and refused, the ways through our lines, what was found, by its kind."""

    target: str
    inputs: int = 0
    refused: int = 0
    ways: int = 0
    seconds: float = 0.0
    findings: dict[str, list[Finding]] = field(default_factory=dict)

    def note(self, finding: Finding) -> bool:
        """Keep a finding, unless enough of its kind are there."""
        same = self.findings.setdefault(finding.kind, [])
        if len(same) < _SAME:
            same.append(finding)
        return len(same) == 1


def judged(target: Target, folder: Path) -> tuple[str | None, str]:
    """Read once: the kind of the finding, None where all is well, and what was said."""
    try:
        target.read(folder)
    except target.errors as error:
        said = str(error)
        return ("several lines" if len(said.splitlines()) > 1 else None), said
    except Exception as error:
        place = _place(error)
        return f"{type(error).__name__} at {place}", " ".join(str(error).split())[:300]
    return None, ""


def run_campaign(target: Target, inputs: int, seconds: float, bounds: Bounds, seed: int = 0) -> Result:
    """Try so many inputs, or for so long."""
    result, started = Result(target.name), time.monotonic()
    with tempfile.TemporaryDirectory(prefix="fieldpose-fuzz-", dir=_memory_folder()) as scratch:
        seeds = target.seeds(Path(scratch) / "made")
        generation = 0
        while result.inputs < inputs and time.monotonic() - started < seconds:
            left_s = seconds - (time.monotonic() - started)
            child = _Child(target, seeds, Path(scratch), bounds, f"{seed}/{generation}", inputs - result.inputs, left_s)
            child.watch(result)
            generation += 1
    result.seconds = time.monotonic() - started
    return result


def replayed(target: Target, finding: Finding, bounds: Bounds) -> tuple[str | None, str]:
    """Read a finding's input once more, watched in the same way: of which kind it is, None where all is well."""
    with tempfile.TemporaryDirectory(prefix="fieldpose-fuzz-", dir=_memory_folder()) as scratch:
        result = Result(target.name)
        _Child(target, [dict(finding.files)], Path(scratch), bounds, "replay", 1, 3600.0).watch(result)
    found = next((kept[0] for kept in result.findings.values()), None)
    if found is not None:
        return found.kind, found.detail
    return None, "refused" if result.refused else "read"


def mutated_files(files: Input, corpus: list[Input], rng: random.Random) -> Input:
    """With one of its files made wrong, parts of which may come from the same file of others."""
    # Of datasets most files are images, which all datasets read alike.
    plain = [name for name in files if not name.endswith(".png")]
    name = rng.choice(plain if plain and rng.random() < _PLAIN else list(files))
    others = [rng.choice(corpus).get(name, b"")] if corpus else []
    return {**files, name: mutated(files[name], others, rng)}


class _Child:
    """A forked process that tries inputs until it is done or one ends it; how many it tried is in shared memory."""

    def __init__(
        self, target: Target, seeds: list[Input], scratch: Path, bounds: Bounds, seed: str, inputs: int, seconds: float
    ) -> None:
        self._target, self._seeds, self._bounds = target, seeds, bounds
        self._scratch, self._seed, self._inputs = scratch, seed, inputs
        self._deadline = time.monotonic() + seconds
        self._counts = mmap.mmap(-1, 24)
        self._current, self._errors = scratch / "current", scratch / "errors"
        sys.stdout.flush()
        sys.stderr.flush()
        self._pid = os.fork()
        if self._pid == 0:
            status = 1
            try:
                self._work()
                status = 0
            except BaseException:
                self._errors.write_text(traceback.format_exc())
            finally:
                os._exit(status)

    def watch(self, result: Result) -> None:
        process = psutil.Process(self._pid)
        number, began_cpu, began = -1, 0.0, time.monotonic()
        hung = False
        while True:
            ended, status = os.waitpid(self._pid, os.WNOHANG)
            if ended:
                break
            at, _, _ = self._read_counts()
            cpu, now = sum(process.cpu_times()[:2]), time.monotonic()
            if at != number:
                number, began_cpu, began = at, cpu, now
            elif cpu - began_cpu > self._bounds.seconds or now - began > 6 * self._bounds.seconds:
                hung = True
                os.kill(self._pid, signal.SIGKILL)
                _, status = os.waitpid(self._pid, 0)
                break
            time.sleep(_POLL_S)
        done, refused, ways = self._read_counts()
        result.inputs, result.refused = result.inputs + max(done, 1), result.refused + refused
        result.ways = max(result.ways, ways)
        for path in sorted(self._scratch.glob("found-*")):
            result.note(msgspec.msgpack.decode(path.read_bytes(), type=Finding))
            path.unlink()
        if os.WIFEXITED(status) and os.WEXITSTATUS(status):
            raise RuntimeError(f"{self._target.name}: {self._errors.read_text()}")
        if hung:
            kind = f"hang: over {self._bounds.seconds:g} s"
        elif os.WIFSIGNALED(status):
            kind = f"crash: {signal.Signals(os.WTERMSIG(status)).name}"
        else:
            return
        files = msgspec.msgpack.decode(self._current.read_bytes(), type=dict[str, bytes])
        result.note(Finding(self._target.name, kind, "", files))

    def _work(self) -> None:
        self._silence()
        folder = self._scratch / "folder"
        shutil.rmtree(folder, ignore_errors=True)
        rng, reach = random.Random(self._seed), Reach()
        corpus: list[Input] = []
        written: Input = {}
        self._limit()
        before_mb = _peak_mb()
        for number in range(self._inputs):
            if time.monotonic() > self._deadline:
                break
            if number < len(self._seeds):
                files = self._seeds[number]
            else:
                files = mutated_files(rng.choice(corpus or self._seeds), corpus, rng)
            # A child that is killed says no more; its last input stands here.
            self._current.write_bytes(msgspec.msgpack.encode(files))
            written = write(folder, files, written)
            reach.begin()
            kind, said = judged(self._target, folder)
            new = reach.end(said)
            grown_mb = _peak_mb() - before_mb
            _, refused, _ = self._read_counts()
            self._counts[:] = struct.pack("<3q", number + 1, refused + (said != "" and kind is None), reach.ways)
            if grown_mb > self._bounds.memory_mb:
                kind, said = f"memory: over {self._bounds.memory_mb} MB", f"{grown_mb:.0f} MB"
            if kind is not None:
                self._keep(Finding(self._target.name, kind, said, files), number)
            elif new and len(corpus) < _MOST_KEPT:
                corpus.append(files)
            if grown_mb > self._bounds.memory_mb:
                return

    def _keep(self, finding: Finding, number: int) -> None:
        kept = len(list(self._scratch.glob("found-*")))
        if kept < 500:
            (self._scratch / f"found-{number}").write_bytes(msgspec.msgpack.encode(finding))

    def _limit(self) -> None:
        size = psutil.Process().memory_info().vms + _ADDRESS_FACTOR * (self._bounds.memory_mb << 20)
        resource.setrlimit(resource.RLIMIT_AS, (size, size))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))

    def _silence(self) -> None:
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, 1)
        os.dup2(null, 2)

    def _read_counts(self) -> tuple[int, int, int]:
        done, refused, ways = struct.unpack("<3q", self._counts[:])
        return done, refused, ways


def write(folder: Path, files: Mapping[str, bytes], written: Input) -> Input:
    """Write what differs from what stands there."""
    for name in written.keys() - files.keys():
        (folder / name).unlink()
    for name, content in files.items():
        if written.get(name) is not content:
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
    return dict(files)


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _memory_folder() -> str | None:
    return "/dev/shm" if os.access("/dev/shm", os.W_OK) else None


def _place(error: Exception) -> str:
    """The innermost of our own lines."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if "site-packages" not in f.filename]
    ours = [f for f in frames if "/fuzzing/" not in f.filename and "/lib/python" not in f.filename] or frames
    return f"{Path(ours[-1].filename).name}:{ours[-1].lineno}"
