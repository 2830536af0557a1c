"""The export command, and the files that it writes, read by plain readers."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from support.commands import save_empty_field
from support.surfaces import BALL_RADIUS, RED, ball_field, read_glb, read_ply

from fieldpose.deploy.cli import main
from fieldpose.deploy.reporting.surfaces import glb, ply
from fieldpose.stages.nerf.surface.mesh import SurfaceMesh, SurfacePoints

CELL = 2 / 32
TETRAHEDRON = SurfaceMesh(
    np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], np.float32),
    np.array([[0, 0, -1], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32),
    np.array([[0, 0, 0], [255, 0, 0], [0, 128, 0], [10, 20, 255]], np.uint8),
    np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32),
)


@pytest.fixture
def field(tmp_path: Path) -> Path:
    path = tmp_path / "ball.safetensors"
    ball_field().save(path)
    return path


def test_a_ply_file_has_what_went_in(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(ply(TETRAHEDRON, ["unit: two\nlines"]))
    header, vertices, faces = read_ply(path)
    assert header[:3] == ["ply", "format binary_little_endian 1.0", "comment unit: two lines"]
    assert [line.split()[-1] for line in header if line.startswith("property")] == [
        "x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "vertex_indices",
    ]  # fmt: skip
    np.testing.assert_array_equal(vertices[:, :3], TETRAHEDRON.points)
    np.testing.assert_array_equal(vertices[:, 3:6], TETRAHEDRON.normals)
    np.testing.assert_array_equal(vertices[:, 6:], TETRAHEDRON.colours)
    np.testing.assert_array_equal(faces, TETRAHEDRON.triangles)
    path.write_bytes(ply(SurfacePoints(TETRAHEDRON.points, TETRAHEDRON.normals, TETRAHEDRON.colours)))
    header, vertices, faces = read_ply(path)
    assert (len(vertices), faces) == (4, [])
    assert not any("face" in line for line in header)


def test_a_glb_file_has_what_went_in_and_turns_and_scales_it(tmp_path: Path) -> None:
    path = tmp_path / "a.glb"
    path.write_bytes(glb(TETRAHEDRON, 0.1, {"unit": "span"}))
    tree, arrays = read_glb(path)
    assert tree["asset"]["version"] == "2.0"
    np.testing.assert_array_equal(arrays["POSITION"], TETRAHEDRON.points)
    np.testing.assert_array_equal(arrays["NORMAL"], TETRAHEDRON.normals)
    np.testing.assert_array_equal(arrays["indices"].reshape(-1, 3), TETRAHEDRON.triangles)
    linear = arrays["COLOR_0"][:, :3] / 65535
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    np.testing.assert_array_equal(np.rint(255 * srgb), TETRAHEDRON.colours)
    assert (arrays["COLOR_0"][:, 3] == 65535).all()
    bounds = tree["accessors"][0]
    assert (bounds["min"], bounds["max"]) == ([0, 0, 0], [1, 2, 3])
    matrix = np.reshape(tree["nodes"][0]["matrix"], (4, 4)).T
    np.testing.assert_allclose(matrix @ (1, 2, 3, 1), (0.1, 0.3, -0.2, 1))
    assert np.linalg.det(matrix) > 0
    np.testing.assert_array_equal(tree["asset"]["extras"]["gltf_from_object"], matrix)
    assert tree["asset"]["extras"]["unit"] == "span"
    targets = [view["target"] for view in tree["bufferViews"]]
    assert targets == [34962, 34962, 34962, 34963]


def test_a_ball_is_exported_as_mesh_and_points(field: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mesh, points = tmp_path / "out" / "ball.ply", tmp_path / "out" / "points.ply"
    assert main(["export", str(field), "--mesh", str(mesh), "--points", str(points), "--resolution", "40"]) == 0
    _, vertices, faces = read_ply(mesh)
    assert len(faces) > 5000
    # The occupied cells have corners, up to a cell away from the ball.
    for values in (vertices, read_ply(points)[1]):
        off = np.linalg.norm(values[:, :3], axis=1) - BALL_RADIUS
        assert np.abs(off).max() < CELL
        assert np.einsum("ij,ij->i", values[:, 3:6], values[:, :3]).mean() > 0.8 * BALL_RADIUS
        assert np.abs(values[:, 6:] - RED).max() <= 2
    said = capsys.readouterr().out
    assert f"{mesh}: {len(faces)} triangles, {len(vertices)} points, within 2 x 2 x 2 (lengths in: span)" in said
    assert f"{points}: " in said
    assert sorted(path.name for path in mesh.parent.iterdir()) == ["ball.ply", "points.ply"]


@pytest.mark.parametrize(("metres", "scale"), [(0.2, 0.2), (None, 1.0)])
def test_a_glb_is_in_metres_where_the_unit_is_known(metres: float | None, scale: float, tmp_path: Path) -> None:
    ball_field(metres).save(tmp_path / "ball.safetensors")
    out = tmp_path / "ball.glb"
    assert main(["export", str(tmp_path / "ball.safetensors"), "--mesh", str(out), "--resolution", "24"]) == 0
    tree, arrays = read_glb(out)
    extras = tree["asset"]["extras"]
    assert (extras["unit"], extras["metres_per_unit"]) == ("span", metres)
    assert ("scaled to metres" in extras["converted"]) == (metres is not None)
    assert np.linalg.norm(arrays["POSITION"], axis=1).mean() == pytest.approx(BALL_RADIUS, abs=CELL)
    assert abs(np.linalg.det(np.reshape(tree["nodes"][0]["matrix"], (4, 4)))) == pytest.approx(scale**3)


def test_a_region_and_a_count_hold(field: Path, tmp_path: Path) -> None:
    out = tmp_path / "points.ply"
    region = ["--region", "-1", "-1", "0", "1", "1", "1"]
    assert main(["export", str(field), "--points", str(out), "--count", "50", "--spacing", "0.05", *region]) == 0
    _, vertices, _ = read_ply(out)
    assert len(vertices) == 50
    assert vertices[:, 2].min() >= 0


def test_a_turntable_can_be_played(field: Path, tmp_path: Path) -> None:
    out = tmp_path / "ball.mp4"
    assert main(["export", str(field), "--turntable", str(out)]) == 0
    video = cv2.VideoCapture(str(out))
    frames = []
    while (read := video.read())[0]:
        frames.append(read[1])
    assert len(frames) / video.get(cv2.CAP_PROP_FPS) == pytest.approx(3)
    middles = np.array([frame[32, 32, ::-1] for frame in frames], float)
    np.testing.assert_allclose(middles, np.tile(RED, (len(frames), 1)), atol=20)
    assert {path.name for path in tmp_path.iterdir()} == {"ball.mp4", "ball.safetensors"}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "nothing to write; give --mesh, --points or --turntable"),
        (["--mesh", "a.obj"], "a.obj: no name of a mesh; end it in .ply or .glb"),
        (["--points", "a.glb"], "a.glb: no name of a file of points; end it in .ply"),
        (["--turntable", "a.gif"], "a.gif: no name of a video; end it in .mp4"),
        (["--mesh", "."], "is a folder; give the name of a file"),
        (["--mesh", "ball.safetensors/a.ply"], "its folder cannot be made"),
        (["--mesh", "a.ply", "--points", "./a.ply"], "--mesh and --points are the same file"),
        (["--mesh", "a.ply", "--resolution", "4"], "--resolution 4: must be from 8 to 2048"),
        (["--mesh", "a.ply", "--least-share", "2"], "--least-share 2: must be from 0 to 1"),
        (["--points", "a.ply", "--spacing", "0"], "--spacing 0: must be a length above 0"),
        (["--points", "a.ply", "--count", "0"], "--count 0: must be at least 1"),
        (["--mesh", "a.ply", "--region", "0", "0", "0", "1", "0", "1"], "the lowest corner, then the highest"),
        (
            ["--mesh", "a.ply", "--resolution", "16", "--region", "0.8", "0.8", "0.8", "1", "1", "1"],
            "ball.safetensors: no surface is seen in the region",
        ),
    ],
)
def test_what_cannot_be_written_is_told_in_one_line(
    arguments: list[str], said: str, field: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(field.parent)
    assert main(["export", field.name, *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert [path.name for path in field.parent.iterdir()] == ["ball.safetensors"]


def test_a_field_that_is_not_there_or_shows_nothing_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    save_empty_field(tmp_path / "empty.safetensors")
    ball_field(views=0).save(tmp_path / "blind.safetensors")
    for name, arguments, said in (
        ("nothing", ["--mesh", "a.ply"], "nothing.safetensors: no such field file"),
        ("empty", ["--mesh", "a.ply"], "empty.safetensors: no surface is seen"),
        ("empty", ["--points", "a.ply"], "empty.safetensors: no surface is seen"),
        ("blind", ["--mesh", "a.ply"], "the field does not tell its training views"),
        ("blind", ["--turntable", "a.mp4"], "the field does not tell its training views"),
    ):
        assert main(["export", f"{name}.safetensors", *arguments]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert said in line
    assert {path.suffix for path in tmp_path.iterdir()} == {".safetensors"}
