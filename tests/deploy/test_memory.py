"""Memory is told of every process that there is."""

from __future__ import annotations

import os
import subprocess
import sys

import psutil
import pytest

from fieldpose.deploy.processes.memory import pss_mb


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux tells")
def test_a_share_is_no_more_than_all_that_is_resident() -> None:
    share = pss_mb(os.getpid())
    assert share is not None
    assert 1.0 < share <= psutil.Process().memory_info().rss / 2**20 + 1.0


def test_a_process_that_is_gone_takes_nothing() -> None:
    gone = subprocess.Popen([sys.executable, "-c", "pass"])
    gone.wait()
    assert pss_mb(gone.pid) is None
