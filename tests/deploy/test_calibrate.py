"""From pictures of a printed board to a camera file, as users have them; and the board to print."""

from __future__ import annotations

import io
import json
import re
import struct
from collections.abc import Iterator, Sequence
from itertools import count
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation
from support.boards import Fisheye, Pinhole, charuco, chess, photograph, poses
from support.commands import fieldpose

from fieldpose.deploy import calibrating, shots
from fieldpose.deploy.calibrating import calibrate
from fieldpose.deploy.cli import main
from fieldpose.deploy.reporting.sheets import Sheet, encoded
from fieldpose.errors import DatasetError, SourceError, UsageError
from fieldpose.stages.camera.boards import Board, Finder, dictionary
from fieldpose.stages.camera.camera_files import read_camera_file
from fieldpose.stages.camera.core import CapturedFrame, Source
from fieldpose.stages.geometry import Camera

CAMERA = Camera(640, 480, 520.0, 523.0, 325.0, 236.0, (-0.2, 0.08, 0.001, -0.0008, 0.0))
UPRIGHT = Camera(480, 640, 520.0, 523.0, 236.0, 325.0, (-0.2, 0.08, 0.001, -0.0008, 0.0))
CHARUCO = Board("charuco", 7, 5)
ORIENTATION = 0x0112


def pictures(sheet: np.ndarray, camera: Camera, where: np.ndarray) -> list[np.ndarray]:
    return [photograph(sheet, Pinhole(camera), pose, seed=i) for i, pose in enumerate(where)]


@pytest.fixture(scope="module")
def board_pictures() -> list[np.ndarray]:
    return pictures(charuco(), CAMERA, poses(25, near=5.0, reach=0.4))


def save(images: Sequence[np.ndarray], folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    for i, image in enumerate(images):
        Image.fromarray(image).save(folder / f"{i:02d}.png")
    return folder


def film(path: Path, images: Sequence[np.ndarray]) -> Path:
    size = (images[0].shape[1], images[0].shape[0])
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 30.0, size)  # type: ignore[attr-defined]
    for image in images:
        writer.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    writer.release()
    return path


def check_is(found: Camera, truth: Camera, reprojected_px: float) -> None:
    assert (found.width, found.height) == (truth.width, truth.height)
    np.testing.assert_allclose((found.fx, found.fy), (truth.fx, truth.fy), rtol=0.002)
    np.testing.assert_allclose((found.cx, found.cy), (truth.cx, truth.cy), atol=1.0)
    x, y = np.meshgrid(np.linspace(20, truth.width - 21, 9), np.linspace(20, truth.height - 21, 7))
    grid = np.stack([x.ravel(), y.ravel()], axis=1)
    # A principal point that is off by a little, and a camera that is turned by as much, look the same.
    theirs, ours = (camera.directions(grid).astype(np.float64) for camera in (truth, found))
    turn, _ = Rotation.align_vectors(ours, theirs)
    assert np.linalg.norm(found.project(turn.apply(theirs)) - grid, axis=1).max() < reprojected_px


def test_photographs_of_a_board_become_a_camera_file(board_pictures: list[np.ndarray], tmp_path: Path) -> None:
    folder, out, figures = (
        save(board_pictures, tmp_path / "photos"),
        tmp_path / "camera.json",
        tmp_path / "figures.json",
    )
    ran = fieldpose("calibrate", folder, "--out", out, "--json", figures, cwd=tmp_path)
    assert ran.returncode == 0, ran.stderr
    camera, told = read_camera_file(out), json.loads(figures.read_text())
    check_is(camera, CAMERA, 0.3)
    assert told["camera"] == json.loads(out.read_text())
    assert (told["seen"], told["shown"]) == (25, 25)
    assert told["terms"] == "k1 k2 p1 p2"
    assert abs(camera.fx - CAMERA.fx) < 4 * told["focal_sd_px"] < 2
    assert told["error_px"] < 0.2
    assert 0.5 < told["covered"] < 1
    assert 30 < told["tilt_deg"] < 45
    assert f"focal length {camera.fx:.1f} +- {told['focal_sd_px']:.1f} px at 640x480" in ran.stdout
    assert f"fieldpose run FIELD --source SOURCE --camera.camera-file {out}" in ran.stdout
    again = fieldpose("calibrate", folder, "--out", out, "--size", 320, cwd=tmp_path)
    assert again.returncode == 0, again.stderr
    small = read_camera_file(out)
    assert (small.width, small.height) == (320, 240)
    assert small.fx == pytest.approx(260, rel=0.004)


def test_photographs_are_turned_upright_once_and_those_held_otherwise_left_out(tmp_path: Path) -> None:
    """Files are as the sensor lies; turned over, three of them would have the principal point elsewhere."""
    for i, image in enumerate(pictures(charuco(), UPRIGHT, poses(17, near=6.0, reach=0.3))):
        exif = Image.Exif()
        exif[ORIENTATION] = 6 if i % 6 == 5 else 8
        Image.fromarray(np.ascontiguousarray(np.rot90(image, -1))).save(
            tmp_path / f"{i:02d}.jpg", quality=97, exif=exif
        )
    found = calibrate(str(tmp_path), CHARUCO, 60)
    assert any(
        "2 photographs count for nothing, since the camera was held otherwise, as 05.jpg" in n for n in found.notes
    )
    assert (found.camera.width, found.camera.height) == (480, 640)
    np.testing.assert_allclose((found.camera.fx, found.camera.cx, found.camera.cy), (520, 236, 325), atol=1.5)


@pytest.mark.parametrize(("camera", "reach", "tall"), [(CAMERA, 0.4, 0.75), (UPRIGHT, 0.25, 1.6)])
def test_a_video_of_a_board(camera: Camera, reach: float, tall: float, tmp_path: Path) -> None:
    """Each view is filmed three times, once of these blurred, and half of them show no board."""
    frames = []
    for i, image in enumerate(pictures(charuco(), camera, poses(25, near=5.0, reach=reach, tall=tall))):
        frames += [cv2.GaussianBlur(image, (0, 0), 2.5), image, np.full_like(image, 90 + i)]
    found = calibrate(str(film(tmp_path / "board.mp4", frames)), CHARUCO, 20)
    check_is(found.camera, camera, 0.8)
    assert found.seen == 75
    assert found.views <= 20 < found.shown


def test_a_video_is_turned_once_as_its_rotation_says(tmp_path: Path) -> None:
    """Frames are stored lying, and the file says that they are to be turned by a quarter, as phones have it."""
    upright = pictures(charuco(), UPRIGHT, poses(14, near=6.0, reach=0.25, tall=1.5))
    path = film(tmp_path / "board.mp4", [np.ascontiguousarray(np.rot90(image)) for image in upright])
    content = bytearray(path.read_bytes())
    matrix = content.index(b"tkhd") + 44
    content[matrix : matrix + 36] = struct.pack(">9i", 0, 1 << 16, 0, -1 << 16, 0, 0, 0, 0, 1 << 30)
    path.write_bytes(content)
    found = calibrate(str(path), CHARUCO, 60).camera
    assert (found.width, found.height) == (480, 640)
    np.testing.assert_allclose((found.fx, found.cx, found.cy), (520, 236, 325), atol=2.5)


def test_a_chessboard(tmp_path: Path) -> None:
    folder = save(pictures(chess(), CAMERA, poses(28, near=5.5, reach=0.22)), tmp_path / "photos")
    found = calibrate(str(folder), Board("chess", 7, 5), 60)
    assert found.views >= 15
    check_is(found.camera, CAMERA, 0.8)
    with pytest.raises(
        DatasetError, match=r"expected a chessboard of 9x6 squares \(8x5 inner.*7x5 squares \(6x4 inner"
    ):
        calibrate(str(folder), Board("chess", 9, 6), 60)


def test_what_shows_too_little_of_a_board_is_told_and_nothing_written(
    board_pictures: list[np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    few, flat = save(board_pictures[:5], tmp_path / "few"), tmp_path / "flat"
    save(pictures(charuco(), CAMERA, poses(12, tilt_deg=0.0)), flat)
    blank = film(tmp_path / "blank.mp4", [np.full((480, 640, 3), 60 + i, np.uint8) for i in range(40)])
    fisheye = tmp_path / "fisheye"
    lens = Fisheye((640, 480), 270.0)
    save([photograph(charuco(), lens, pose, seed=i) for i, pose in enumerate(poses(36, reach=1.0, near=3.0))], fisheye)
    for source, options, said in (
        (few, [], "5 views show the board, but at least 8 are needed"),
        (flat, [], "leave the focal length open"),
        (blank, [], "no board in any of 40 images; expected a ChArUco board of 7x5 squares with markers of family 4x4"),
        (fisheye, [], "a fisheye lens, which is not supported"),
        (few, ["--squares", "9x6"], "the images show a board of 7x5 squares; give --squares 7x5"),
        (
            few,
            ["--board", "chess", "--squares", "10x7"],
            "markers of family 4x4 in one image; give --board charuco --family 4x4",
        ),
        (tmp_path / "none.mp4", [], "no such video"),
        (tmp_path, [], "no images in this folder"),
    ):
        assert main(["calibrate", str(source), "--out", str(tmp_path / "camera.json"), *options]) == 2
        lines = capsys.readouterr().err.splitlines()
        assert said in lines[-1], lines
        assert str(source) in lines[-1]
        assert not (tmp_path / "camera.json").exists()


def test_what_to_film_again_is_said(tmp_path: Path) -> None:
    folder = save(pictures(charuco(), CAMERA, poses(12, near=8.0, reach=0.08)), tmp_path / "middle")
    notes = calibrate(str(folder), CHARUCO, 60).notes
    assert any(
        "the board was not seen enough at the top left, " in note and "bottom right of the image" in note
        for note in notes
    )


def test_a_live_camera_films_until_ctrl_c(board_pictures: list[np.ndarray], monkeypatch: pytest.MonkeyPatch) -> None:
    def frames(first: int) -> Iterator[CapturedFrame]:
        for i in count():
            if i == len(board_pictures):
                raise KeyboardInterrupt
            yield CapturedFrame(i, board_pictures[i], "rgb8", CAMERA, f"{i}")

    monkeypatch.setattr(shots, "open_source", lambda config: Source("camera:0", "wall", frames))
    assert calibrate("camera:0", CHARUCO, 60).camera.fx == pytest.approx(CAMERA.fx, rel=0.002)
    monkeypatch.setattr(shots, "open_source", lambda config: Source("a video", "own", frames))
    with pytest.raises(KeyboardInterrupt):
        calibrate("mcap:a", CHARUCO, 60)


def test_of_a_long_video_some_frames_are_looked_at(
    board_pictures: list[np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    def frames(first: int) -> Iterator[CapturedFrame]:
        yield from (CapturedFrame(i, image, "rgb8", CAMERA, f"{i}") for i, image in enumerate(board_pictures * 2))

    monkeypatch.setattr(calibrating, "_LOOKED_AT", 25)
    monkeypatch.setattr(shots, "open_source", lambda config: Source("a video", "own", frames, 60))
    found = calibrate("mcap:a", CHARUCO, 60)
    assert found.seen == 25
    assert "only 50 of 60 frames could be read: is the file whole?" in found.notes


@pytest.mark.parametrize(("paper", "points"), [("a4", (841.89, 595.28)), ("letter", (792.0, 612.0))])
def test_a_printed_board_has_its_size(paper: str, points: tuple[float, float], tmp_path: Path) -> None:
    for suffix in ("png", "pdf"):
        assert main(["calibrate", "--print-board", str(tmp_path / f"b.{suffix}"), "--paper", paper]) == 0
    image = Image.open(tmp_path / "b.png")
    dots_mm = image.info["dpi"][0] / 25.4
    found = Finder(CHARUCO)(np.array(image.convert("L")))
    assert found is not None
    assert len(found.ids) == 24
    at = dict(zip(found.ids.tolist(), found.pixels / dots_mm, strict=True))
    assert np.linalg.norm(at[5] - at[0]) == pytest.approx(5 * 30, abs=0.05)
    assert np.linalg.norm(at[18] - at[0]) == pytest.approx(3 * 30, abs=0.05)
    np.testing.assert_allclose(np.array(image.size) / dots_mm, np.array(points) / 72 * 25.4, atol=0.1)
    box = re.search(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", (tmp_path / "b.pdf").read_bytes())
    assert box is not None
    np.testing.assert_allclose([float(n) for n in box.groups()], points, atol=0.3)


@pytest.mark.parametrize(
    "sheet",
    [
        Sheet(Board("charuco", 5, 7, 0.7, "tag36h11"), 0.03, "letter"), Sheet(Board("chess", 10, 7), 0.02, dots=150),
        Sheet(Board("charuco", 11, 8, 0.75, "5x5"), 0.018), Sheet(CHARUCO, 0.01),
    ],
)  # fmt: skip
def test_a_printed_board_is_found_and_its_text_is_whole(sheet: Sheet) -> None:
    image = Image.open(io.BytesIO(encoded(sheet, ".png")))
    page, dots = np.array(image.convert("L")), image.info["dpi"][0]
    found = Finder(sheet.board)(page)
    assert found is not None
    assert len(found.ids) == len(sheet.board.corners())
    margin = round(5 / 25.4 * dots)
    assert (page[:margin] == 255).all()
    assert (page[-margin:] == 255).all()
    assert (page[:, :margin] == 255).all()
    assert (page[:, -margin:] == 255).all()
    below = page[int(found.pixels[:, 1].max() + sheet.square_m * 1000 / 25.4 * dots) + 2 :]
    longest = max(len(run) for row in below for run in bytes(row // 255).split(b"\1"))
    assert longest == pytest.approx(100 / 25.4 * dots, abs=3)
    blocks = np.diff((below == 0).any(axis=1).astype(int))
    assert (blocks == 1).sum() >= 3


def test_what_cannot_be_printed_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sheet = str(tmp_path / "board.png")
    for arguments, said in (
        (["--print-board", sheet, "--squares", "12x9"], "a board of 12x9 squares of 30 mm is 360 x 270 mm, more than"),
        (["--print-board", str(tmp_path / "board.jpg")], "no name of a sheet to print; end it in .png or .pdf"),
        (["--print-board", sheet, "--squares", "7"], "--squares 7: expected squares across and down, as 7x5"),
        (["--print-board", sheet, "--marker", "1.2"], "markers are 0.3 to 0.95 of a square, got 1.2"),
        (["--print-board", sheet, "--square", "0"], "--square 0.0: expected the length"),
        (["--print-board", sheet, "--dpi", "5"], "--dpi 5: expected 72 to 1200"),
        (["--print-board", sheet, "board.mp4"], "reads no source"),
        ([], "give a SOURCE and --out FILE to calibrate, or --print-board FILE"),
        (["board.mp4", "--out", sheet, "--most", "3"], "--most must be at least 8"),
        (["board.mp4", "--out", sheet, "--seconds", "0"], "--seconds 0.0: expected more than 0"),
    ):
        assert main(["calibrate", *arguments]) == 2
        assert said in capsys.readouterr().err
        assert not list(tmp_path.iterdir())
    assert main(["calibrate", "--print-board", sheet, "--square", "0.02", "--marker", "0.014"]) == 0
    assert "--square 0.02 --marker 0.7 --family 4x4" in capsys.readouterr().out
    with pytest.raises(UsageError, match=r"give --square 0\.0195 at most"):
        encoded(Sheet(Board("chess", 14, 8), 0.03), ".pdf")


def test_another_source_than_images_is_refused() -> None:
    with pytest.raises(SourceError, match="expected a video, a camera, a recording or a folder"):
        calibrate("dataset:nothing:train", CHARUCO, 60)


def test_a_marker_that_lies_about_is_no_reason(tmp_path: Path) -> None:
    for i, image in enumerate(pictures(charuco(), CAMERA, poses(14, near=5.0))):
        if i == 3:
            image[4:64, 4:64] = 255
            image[10:58, 10:58] = cv2.aruco.generateImageMarker(dictionary("4x4"), 30, 48)[..., None]
        Image.fromarray(image).save(tmp_path / f"{i:02d}.png")
    assert calibrate(str(tmp_path), CHARUCO, 60).views >= 10


@pytest.mark.parametrize("options", [["--square", "0.001", "--dpi", "72"], ["--square", "1e-7"]])
def test_squares_too_small_to_draw_are_refused(
    tmp_path: Path, options: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "board.png"
    assert main(["calibrate", "--print-board", str(out), *options]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "--square" in said
    assert not out.exists()
