"""The commands around recordings: record a running bus, list what is held, save what can be saved."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from support import bus_samples

from fieldpose.bus.ports import Outbox
from fieldpose.bus.reading import info
from fieldpose.bus.topics import POSE, STATE, Address
from fieldpose.bus.transport import ZenohBus
from fieldpose.deploy.cli import main
from fieldpose.deploy.processes.endpoints import free_port

ADDRESS = Address("fieldpose", "mug", "cam")


@pytest.fixture
def talking(hub: str) -> Iterator[str]:
    """A hub with one who says something all the time."""
    bus, stop = ZenohBus(hub), threading.Event()
    outbox, samples = Outbox(bus, ADDRESS, "stage"), bus_samples.every_message()

    def talk() -> None:
        while not stop.wait(0.01):
            outbox.publish(POSE, samples[POSE])
            outbox.publish(STATE, samples[STATE])

    talker = threading.Thread(target=talk)
    talker.start()
    yield hub
    stop.set()
    talker.join()
    bus.close()


def test_record_then_info(talking: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording, listed = tmp_path / "a.mcap", tmp_path / "a.json"
    assert main(["record", str(recording), "--connect", talking, "--open", "--seconds", "0.6"]) == 0
    assert "no message lost" in capsys.readouterr().out
    assert main(["info", str(recording), "--json", str(listed)]) == 0
    said, held = capsys.readouterr().out, json.loads(listed.read_text())
    assert "fieldpose/track/mug/cam/pose" in said
    assert "no message lost" in said
    assert {topic["topic"] for topic in held["topics"]} == {"pose", "state"}
    assert held["messages"] == sum(topic["messages"] for topic in held["topics"]) > 10
    assert held["lossless"]


def test_recording_where_no_hub_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("fieldpose.deploy.commands.record._HUB_S", 0.2)
    hub = f"tcp/127.0.0.1:{free_port()}"
    assert main(["record", str(tmp_path / "a.mcap"), "--connect", hub, "--open", "--seconds", "1"]) == 2
    assert f"no hub answers at {hub}" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_recover_saves_an_unfinished_recording_under_a_new_name(
    talking: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = tmp_path / "a.mcap"
    assert main(["record", str(recording), "--connect", talking, "--open", "--seconds", "1.4"]) == 0
    whole = recording.read_bytes()
    recording.unlink()
    # What was flushed after the first second is whole.
    (tmp_path / "a.mcap.partial").write_bytes(whole[: int(len(whole) * 0.8)])
    assert main(["recover", str(recording)]) == 0
    saved = info(tmp_path / "a.recovered.mcap")
    assert saved.messages > 0
    assert not saved.lossless
    assert f"{saved.messages} messages saved" in capsys.readouterr().out
    assert main(["info", str(tmp_path / "a.recovered.mcap")]) == 0
    assert "NOT LOSSLESS" in capsys.readouterr().out
    assert main(["recover", str(recording)]) == 2
    assert "is there already" in capsys.readouterr().err


def test_a_recording_without_settings_cannot_be_replayed(
    talking: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = tmp_path / "a.mcap"
    main(["record", str(recording), "--connect", talking, "--open", "--seconds", "0.2"])
    capsys.readouterr()
    assert main(["replay", str(recording)]) == 2
    assert "holds no field" in capsys.readouterr().err.splitlines()[-1]
