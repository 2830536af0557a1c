"""The fuzz command finds what it is to find, and everything that reads bytes from outside bears a short run of it."""

from __future__ import annotations

import os
import random
from pathlib import Path

import numpy as np
import pytest

from fieldpose.deploy.cli import main
from fieldpose.deploy.fuzzing.campaign import (
    Bounds,
    Input,
    Target,
    judged,
    mutated_files,
    replayed,
    run_campaign,
    write,
)
from fieldpose.deploy.fuzzing.targets import targets
from fieldpose.errors import CodecError


@pytest.mark.parametrize("name", targets())
def test_every_reader_takes_right_inputs_and_bears_wrong_ones(name: str, tmp_path: Path) -> None:
    target = targets()[name]
    right = target.seeds(tmp_path / "made")
    written: Input = {}
    for files in right:
        written = write(tmp_path / "folder", files, written)
        assert judged(target, tmp_path / "folder") == (None, "")
    for number in range(30 if name == "bag" else 200):
        rng = random.Random(f"{name}/{number}")
        files = mutated_files(rng.choice(right), right, rng)
        written = write(tmp_path / "folder", files, written)
        kind, said = judged(target, tmp_path / "folder")
        assert kind is None, f"input {number}: {kind}: {said}"


def bad_reader(path: Path) -> None:
    data = (path / "a").read_bytes()
    if data == b"seed 0":
        raise CodecError("refused")
    if data == b"seed 1":
        while True:
            pass
    if data == b"seed 2":
        os.kill(os.getpid(), 11)
    if data == b"seed 3":
        np.zeros(300 << 20, np.uint8)[::4096] = 1
    if data == b"seed 4":
        raise KeyError("a")


def test_other_errors_hangs_crashes_and_memory_are_found() -> None:
    kinds = []
    bounds = Bounds(seconds=2.0, memory_mb=200)
    for i in range(5):
        target = Target("bad", bad_reader, lambda _, i=i: [{"a": b"seed %d" % i}], (CodecError,))
        result = run_campaign(target, 1, 60.0, bounds)
        kinds.append(next(iter(result.findings), None))
        for found in result.findings.values():
            assert replayed(target, found[0], bounds)[0] == kinds[-1]
    assert kinds[:4] == [None, "hang: over 2 s", "crash: SIGSEGV", "memory: over 200 MB"]
    assert str(kinds[4]).startswith("KeyError at test_fuzzing.py")


def test_the_command_lists_runs_and_replays(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "fuzz", "--inputs", "0"]) == 2
    assert "dataset/llff" in capsys.readouterr().err
    run = ["bench", "fuzz", "--targets", "wire/pose", "--inputs", "50", "--out", str(tmp_path)]
    assert main([*run, "--json", str(tmp_path / "f.json")]) == 0
    assert "wire/pose" in (tmp_path / "f.json").read_text()
    (tmp_path / "x.fuzz").write_bytes(b"x")
    assert main(["bench", "fuzz", "--replay", str(tmp_path / "x.fuzz")]) == 2
    assert "no finding" in capsys.readouterr().err
