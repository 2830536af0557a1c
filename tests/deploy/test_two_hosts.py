"""The demo on two hosts, by TLS: the camera, the hub and a recorder on one, tracking and the stages on the other."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from fieldpose.bus.messages import Stats
from fieldpose.bus.open_recording import partial_path
from fieldpose.bus.reading import info, read_recording
from fieldpose.bus.topics import STATS
from fieldpose.deploy.benchmarks.two_hosts import TwoHosts, two_hosts
from fieldpose.deploy.cli import main
from fieldpose.deploy.graph import AT_WORK
from fieldpose.deploy.reporting.gathering import recorded_results
from fieldpose.deploy.reporting.results import FrameResult
from fieldpose.deploy.scene import demo_file
from fieldpose.stages.nerf.field import load_metadata

CUT_S, BACK_S = 5.0, 2.0
BEFORE_S, AFTER_S = 2.0, 3.0
FIRST_BYTES = 500_000
SPEED, RATE_HZ = 0.6, 18.0
START_S = 240.0
USUAL_DEG = 0.1
"""On one host half of the demo's poses err by 0.04 degrees at most."""
WRONG_DEG, WRONG = 1.0, 0.02
"""Beyond these a pose of the demo that was said to be sure is wrong, see deploy/benchmarks/sequences.py."""


@pytest.fixture
def hosts() -> Iterator[TwoHosts]:
    with ExitStack() as closing:
        try:
            made = closing.enter_context(two_hosts())
        except (OSError, subprocess.CalledProcessError) as error:
            pytest.skip(f"no right to make network namespaces: {error}")
        yield made


def until(condition: Callable[[], bool], timeout_s: float) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.mark.slow
def test_the_demo_is_tracked_over_a_link_and_again_within_2_s_after_that_was_cut(
    hosts: TwoHosts, tmp_path: Path
) -> None:
    certs, recording, field = tmp_path / "certs", tmp_path / "run.mcap", demo_file("field.safetensors")
    assert main(["certs", str(certs), "--hosts", hosts.camera_at, hosts.stages_at]) == 0
    hub = f"tls/{hosts.camera_at}:7447"
    joins = ("--connect", hub, "--tls", certs)
    apart = (*joins, "--no-shared-memory")
    source = ("--camera.source", f"mcap:{demo_file('sequence.mcap')}", "--camera.speed", SPEED)
    with ExitStack() as closing:
        closing.enter_context(hosts.started(hosts.camera, "stage", "hub", "--listen", hub, "--tls", certs))
        for name in AT_WORK:
            threads = ("--threads", "1", "--field", field)
            closing.enter_context(hosts.started(hosts.stages, "stage", name, *apart, *threads))
        recorder = closing.enter_context(hosts.started(hosts.camera, "record", recording, *joins))
        sends = ("stage", "camera", *apart, *source, "--field", field)
        camera = closing.enter_context(hosts.started(hosts.camera, *sends))
        progress = partial_path(recording)
        until(lambda: progress.exists() and progress.stat().st_size > FIRST_BYTES, START_S)
        time.sleep(BEFORE_S)
        began_ns = time.time_ns()
        hosts.cut()
        time.sleep(CUT_S)
        hosts.mend()
        back_ns = time.time_ns()
        time.sleep(AFTER_S)
        assert camera.poll() is None, "the source is too short"
        assert recorder.poll() is None
    _, frames = recorded_results(recording, None, load_metadata(field).frame.object_from_dataset)
    sure = [frame for frame in frames if frame.state == "tracking" and frame.answered_ns is not None]
    before, after = [f for f in sure if answered(f) < began_ns], [f for f in sure if answered(f) > back_ns]
    assert len(before) > 10
    assert after
    assert (answered(after[0]) - back_ns) / 1e9 < BACK_S
    errors = np.array([frame.errors for frame in sure if frame.errors is not None])
    assert np.median(errors[:, 0]) < USUAL_DEG
    assert (errors[:, 0] < WRONG_DEG).all()
    assert (errors[:, 1] < WRONG).all()
    # What was lost is told: by matching of the camera's frames, and by the recording of what was said over there.
    said = [one.message for one in read_recording(recording, (STATS,)) if isinstance(one.message, Stats)]
    lost = max(stats.gaps for stats in said if stats.stage == "matching")
    assert 0.8 * CUT_S * RATE_HZ < lost < 1.5 * CUT_S * RATE_HZ
    held = info(recording)
    assert not held.lossless
    assert sum(source.missing for source in held.sources) > 0


def answered(frame: FrameResult) -> int:
    assert frame.answered_ns is not None
    return frame.answered_ns
