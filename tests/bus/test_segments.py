"""Shared memory that nobody has open any more is removed at the end of a run, and no other."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from fieldpose.bus.segments import removed_orphans, segments_of


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr("fieldpose.bus.segments._FOLDER", tmp_path)
    return tmp_path


def test_orphans_go_and_what_somebody_uses_or_used_before_stays(folder: Path) -> None:
    names = ("orphan.zenoh", "theirs.zenoh", "before.zenoh", "during.zenoh", "other.txt")
    orphan, theirs, before, during, other = paths = [folder / name for name in names]
    for path in paths:
        path.touch()
    code = f"file = open({str(theirs)!r}); print(flush=True); input()"
    user = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert user.stdout is not None
    user.stdout.readline()
    with before.open():
        with removed_orphans():
            got = during.open()
            assert segments_of([os.getpid()]) == {before, during}
        assert {path.name for path in folder.iterdir()} == {theirs.name, before.name, other.name}
    got.close()
    user.communicate(b"\n")
    with removed_orphans():
        pass
    assert list(folder.iterdir()) == [other]
    assert not orphan.exists()


def test_without_shared_memory_there_is_nothing_to_remove(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fieldpose.bus.segments._FOLDER", folder / "none")
    with removed_orphans():
        pass
    assert list(folder.iterdir()) == []
