"""Many cameras, played from a recording by real processes: everything is sent, and everything comes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec
import pytest
from support.bus_samples import frame, guess, matches, view

from fieldpose.bus.messages import Header, Message
from fieldpose.bus.ports import first_header
from fieldpose.bus.recording import RecordingWriter
from fieldpose.bus.topics import FRAME, GUESS, MATCHES, VIEW, Address, Topic
from fieldpose.deploy.cli import main

FRAMES, PERIOD_NS, BEGAN_NS = 10, 50_000_000, 1_000_000_000


def header(source: str, number: int) -> Header:
    at_ns = BEGAN_NS + number * PERIOD_NS
    return msgspec.structs.replace(first_header(number, at_ns), source=source, sequence=number, sent_ns=at_ns)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Half a second of one camera, with tracking, rendering and matching."""
    path, address = tmp_path / "run.mcap", Address()
    writer = RecordingWriter(path)
    senders: list[tuple[str, Topic[Any], Message]] = [
        ("camera", FRAME, frame()), ("tracking", GUESS, guess()), ("rendering", VIEW, view()),
        ("matching", MATCHES, matches(first_header(0, 0))),
    ]  # fmt: skip
    for number in range(FRAMES):
        for source, topic, message in senders:
            message.header = header(source, number)
            writer.write(address.key(topic), topic, message, message.header.sent_ns)
    writer.close()
    return path


def test_all_that_was_recorded_is_sent_for_each_camera_and_comes(recording: Path, tmp_path: Path) -> None:
    figures = tmp_path / "scale.json"
    arguments = ["--recording", str(recording), "--cameras", "2", "--seconds", "0.5", "--json", str(figures)]
    assert main(["bench", "scale", *arguments]) == 0
    made = json.loads(figures.read_text())
    assert made["topics"]["frame"] == {
        "per_s": 20.0, "bytes_per_s": pytest.approx(20 * 600, rel=0.5), "readers": 2
    }  # fmt: skip
    assert set(made["topics"]) == {"frame", "guess", "view", "matches"}
    row = made["cameras"]["2"]
    assert row["processes"] == 2 * 2 + 2
    assert row["links"] == 7 * 6 // 2
    assert row["gaps"] == 0
    # Frames and views are read by tracking and matching, guesses by rendering.
    assert row["received"] == 2 * FRAMES * (2 + 2 + 1)
    assert row["age_ms"]["p99"] >= row["age_ms"]["p50"] > 0


@pytest.mark.parametrize("arguments", [["--cameras", "0"], ["--cameras", "65"], ["--seconds", "0"]])
def test_mistakes_are_one_line(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "scale", *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "expected at most 600 seconds and 1 to 64 cameras" in line
