"""`fieldpose frame` and `fieldpose info` on fields: frames and units, and the page on which points are clicked."""

from __future__ import annotations

import base64
import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from support.browser import Browser, needs_browser
from support.surfaces import BALL_RADIUS, ball_field

from fieldpose.deploy.cli import main
from fieldpose.deploy.scene import demo_file
from fieldpose.stages.geometry import (
    Camera,
    Similarity,
    camera_centre,
    points_at_depth,
    rotation_about,
    rotation_error_deg,
    translation_error,
)
from fieldpose.stages.nerf.datasets import load_dataset
from fieldpose.stages.nerf.field import load_field, load_metadata
from fieldpose.stages.nerf.framing import reframed

FLOOR = -0.66
CLICKS = """
(async () => {
  await Promise.all(known.views.map((view) => view.picture.decode()));
  const canvas = document.getElementById("canvas");
  const click = (what, x, y) => {
    document.querySelector(`input[value=${what}]`).click();
    const box = canvas.getBoundingClientRect();
    const at = { clientX: box.left + x * box.width, clientY: box.top + y * box.height, bubbles: true };
    canvas.dispatchEvent(new MouseEvent("click", at));
  };
  click("distance", 0.01, 0.01);
  click("distance", 0.5, 0.5); click("distance", 0.6, 0.5);
  click("origin", 0.45, 0.5);
  click("up", 0.5, 0.45); click("up", 0.55, 0.5); click("up", 0.45, 0.55);
  const metres = document.getElementById("metres");
  metres.value = "0.25";
  metres.dispatchEvent(new Event("input"));
})()
"""


@pytest.fixture
def field(tmp_path: Path) -> Path:
    path = tmp_path / "ball.safetensors"
    ball_field().save(path)
    return path


def test_a_known_distance_gives_metres(field: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Views show in their middle where the ball is nearest to them."""
    told, eyes = tmp_path / "told.json", [camera_centre(load_metadata(field).cameras[i].pose) for i in (0, 6)]
    apart = float(np.linalg.norm(eyes[0] - eyes[1]) / np.linalg.norm(eyes[0]) * BALL_RADIUS)
    spots = ["0:31.5,31.5", "6:31.5,31.5"]
    assert main(["frame", str(field), "--known-distance", *spots, "0.5", "--json", str(told)]) == 0
    assert "are 0.5 m apart now" in capsys.readouterr().out
    figures, metadata = json.loads(told.read_text()), load_metadata(field)
    assert figures["measured"] == pytest.approx(apart, rel=0.05)
    assert figures["object_from_dataset"]["scale"] == pytest.approx(0.5 / figures["measured"])
    assert (metadata.metres_per_unit, metadata.unit, metadata.frame.unit) == (1.0, "metre", "span")
    assert main(["info", str(field)]) == 0
    assert "lengths in metres" in capsys.readouterr().out


def test_up_and_origin_are_where_they_were_said_to_be(field: Path) -> None:
    before = load_metadata(field)
    assert main(["frame", str(field), "--up=0,1,1", "--origin=0.1,0.2,0.3", "--scale", "10"]) == 0
    after = load_metadata(field)
    frame = after.frame.object_from_dataset
    np.testing.assert_allclose(frame.of_points(np.array([[0.1, 0.2, 0.3]])), [[0, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(frame.of_points(np.array([[0.1, 1.2, 1.3]])), [[0, 0, 10 * np.sqrt(2)]], atol=1e-12)
    np.testing.assert_allclose(frame.rotation @ [1, 0, 0], [1, 0, 0], atol=1e-12)
    centres = [np.array([camera_centre(c.pose) for c in m.cameras]) for m in (before, after)]
    np.testing.assert_allclose(frame.of_points(centres[0]), centres[1], atol=1e-9)
    assert after.unit == "unit that was chosen for the field"


def test_it_is_taken_back_and_another_file_leaves_the_field_alone(field: Path, tmp_path: Path) -> None:
    other, before = tmp_path / "other.safetensors", field.read_bytes()
    assert main(["frame", str(field), "--up=1,0,0", "--scale", "3", "--out", str(other)]) == 0
    assert field.read_bytes() == before
    assert main(["frame", str(other), "--metres-per-unit", "0.001"]) == 0
    assert main(["frame", str(other), "--reset"]) == 0
    found, given = load_field(other).metadata, load_field(field).metadata
    np.testing.assert_allclose([c.pose for c in found.cameras], [c.pose for c in given.cameras], atol=1e-12)
    assert (found.unit, found.frame, found.metres_per_unit) == (given.unit, given.frame, given.metres_per_unit)


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ([], "nothing to change"),
        (["--reset", "--scale", "2"], "takes everything back"),
        (["--scale", "2", "--metres-per-unit", "1"], "give one of them"),
        (["--scale", "-1"], "--scale -1: must be more than 0"),
        (["--up=0,0,0"], "is no direction"),
        (["--up=1,2"], "expected a direction X,Y,Z"),
        (["--origin=nan,0,0"], "expected a point X,Y,Z"),
        (["--origin=0:1,1"], "0 shows nothing solid at pixel 1,1"),
        (["--up=plane"], "no plane was found under the object"),
        (["--known-distance", "1,0,0", "1,0,0", "2"], "are the same point"),
        (["--known-distance", "1,0,0", "0,0,0", "nan"], "--known-distance nan: must be more than 0"),
        (["--page", "a.txt"], "expected a name that ends in .html"),
        (["--page", "a.html", "--scale", "2"], "only writes the page"),
        (["--page", "a.html", "--json", "b.json"], "only writes the page"),
        (["--scale", "1e-300"], "lengths would be 1e-300 times the dataset's"),
        (["--origin=-500000,-5000000,0"], "where positions are good to"),
    ],
)
def test_what_cannot_be_meant_is_refused_and_changes_nothing(
    field: Path, options: list[str], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before = field.read_bytes()
    assert main(["frame", str(field), *options]) == 2
    said = capsys.readouterr().err
    assert complaint in said
    assert said.count("\n") == 1
    assert field.read_bytes() == before


def test_the_plane_is_what_things_stand_on(tmp_path: Path) -> None:
    """The demo's things stand on a floor whose normal is z."""
    given = load_field(demo_file("field.safetensors"))
    given.metadata = reframed(given.metadata, Similarity(2.0, rotation_about(np.ones(3), 1.0)[:3, :3], np.ones(3)))
    path = tmp_path / "turned.safetensors"
    given.save(path)
    assert main(["frame", str(path), "--up", "plane", "--origin", "plane"]) == 0
    frame = load_metadata(path).frame.object_from_dataset
    assert np.degrees(np.arccos(frame.rotation[2, 2])) < 0.5
    floor = frame.of_points(np.array([[0.0, 0.0, FLOOR], [1.0, 1.0, FLOOR]]))
    np.testing.assert_allclose(floor[:, 2], 0, atol=0.02)


def test_poses_are_found_in_the_new_frame(tmp_path: Path) -> None:
    moved = Similarity(0.1, rotation_about(np.array([1.0, 0.0, 2.0]), 2.0)[:3, :3], np.array([0.5, 0.0, -0.2]))
    given = load_field(demo_file("field.safetensors"))
    given.metadata = reframed(given.metadata, moved)
    path, told = tmp_path / "moved.safetensors", tmp_path / "pose.json"
    given.save(path)
    test = load_dataset(demo_file("transforms_test.json").parent, "test")
    record = test.images[3]
    assert main(["estimate", str(path), str(record.path), "--json", str(told)]) == 0
    found, truth = (
        np.array(json.loads(told.read_text())["cam_from_object"]),
        moved.of_poses(record.cam_from_object[None])[0],
    )
    assert rotation_error_deg(found, truth) < 0.5
    assert translation_error(found, truth) < 0.02 * moved.scale


@needs_browser
def test_clicks_in_a_browser_put_the_command_together(field: Path, tmp_path: Path) -> None:
    out = tmp_path / "page.html"
    assert main(["frame", str(field), "--page", str(out)]) == 0
    with Browser(out.as_uri(), tmp_path / "profile") as browser:
        browser.wait_for("document.readyState === 'complete' && typeof known === 'object'")
        browser.ask(CLICKS)
        told = browser.wait_for("document.getElementById('command').textContent")
    words = shlex.split(told)
    assert words[:3] == ["fieldpose", "frame", str(field)]
    up, origin, option, *distance = words[3:]
    assert (up.partition("=")[0], origin.partition("=")[0], option) == ("--up", "--origin", "--known-distance")
    first, second = (np.array([float(v) for v in spot.split(",")]) for spot in distance[:2])
    for point in (first, second):
        assert np.linalg.norm(point) == pytest.approx(BALL_RADIUS, rel=0.15)
    assert float(distance[2]) == 0.25
    assert main(words[1:]) == 0
    metadata = load_metadata(field)
    assert metadata.frame.object_from_dataset.scale == pytest.approx(0.25 / np.linalg.norm(first - second), rel=1e-4)


def test_what_the_unit_is_called_goes_along(field: Path) -> None:
    for metres, unit in (("1", "metre"), ("0.001", "span"), ("1", "metre")):
        assert main(["frame", str(field), "--metres-per-unit", metres]) == 0
        metadata = load_metadata(field)
        assert (metadata.metres_per_unit, metadata.unit) == (float(metres), unit)
    assert main(["frame", str(field), "--reset"]) == 0
    assert (load_metadata(field).metres_per_unit, load_metadata(field).unit) == (None, "span")


@pytest.mark.parametrize(
    "options", [["--up", "plane"], ["--origin", "plane"], ["--origin", "a:1,2"], ["--page", "p.html"]]
)
def test_fields_without_training_views_are_refused_where_these_are_needed(
    tmp_path: Path, options: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    given = ball_field()
    given.metadata.cameras.clear()
    given.save(tmp_path / "bare.safetensors")
    assert main(["frame", "bare.safetensors", *options]) == 2
    assert "does not tell its training views" in capsys.readouterr().err
    assert main(["crop", "bare.safetensors", "--box", "-1", "-1", "-1", "1", "1", "1", "--picture", "p.jpg"]) == 2
    assert "does not tell its training views" in capsys.readouterr().err


def test_a_page_holds_views_and_where_their_pixels_are(field: Path, tmp_path: Path) -> None:
    out = tmp_path / "page.html"
    assert main(["frame", str(field), "--page", str(out)]) == 0
    text = out.read_text()
    assert not re.findall(r"(?:src|href)=[\"']?https?:", text)
    known = json.loads(re.search(r"const known = (\{.*\});", text)[1])
    assert [view["name"] for view in known["views"]] == [str(i) for i in range(12)]
    for view in known["views"]:
        (width, height), lens = view["size"], view["lens"]
        levels = np.frombuffer(base64.b64decode(view["depth"]), "<u2").reshape(height, width)
        rows, columns = np.nonzero(levels)
        assert 0.05 < len(rows) / levels.size < 0.9
        depth = view["near"] + (levels[rows, columns].astype(float) - 1) * view["step"]
        object_from_cam = np.vstack([np.reshape(view["object_from_cam"], (3, 4)), [0, 0, 0, 1]])
        pixels = np.stack([columns, rows], axis=1).astype(float)
        points = points_at_depth(Camera(width, height, *lens), np.linalg.inv(object_from_cam), pixels, depth)
        assert np.median(np.abs(np.linalg.norm(points, axis=1) - BALL_RADIUS)) < 0.06
        assert view["image"].startswith("data:image/jpeg;base64,")
