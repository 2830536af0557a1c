"""From pictures without poses to a dataset, as users have them: a video file, a folder of photographs."""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import count
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from support.commands import fieldpose
from support.papered_room import cameras_before_a_wall, photograph
from support.wall_marker import MIDDLE, RIGHT, SIZE, UP, with_marker

from fieldpose.deploy import capturing, shots
from fieldpose.deploy.capturing import CAMERA_FILE, NO_OVERLAP, TOO_LITTLE, advice, capture, summary
from fieldpose.deploy.cli import main
from fieldpose.errors import DatasetError, GeometryError, SourceError
from fieldpose.stages.camera.camera_files import read_camera_file
from fieldpose.stages.camera.core import CapturedFrame, Source
from fieldpose.stages.geometry import Camera, camera_centres, look_at, rotation_error_deg
from fieldpose.stages.nerf.datasets import load_dataset
from fieldpose.stages.structure.mapping import Mapped
from fieldpose.stages.structure.similarity import align

LENS = Camera(480, 360, 400.0, 400.0, 239.5, 179.5)
ORIENTATION = 0x0112


def walk(count: int) -> np.ndarray:
    """cam_from_object of a camera that walks along a corner of the room and looks at it."""
    along = np.linspace(-1.0, 1.0, count)
    eyes = np.stack([-0.6 + 0.5 * np.cos(along), 0.8 * along, 0.2 * np.sin(3 * along)], axis=1)
    return np.stack([look_at(eye, (1.8, 1.0, -0.2), (0, 0, 1)) for eye in eyes])


@pytest.fixture(scope="module")
def pictures() -> list[np.ndarray]:
    return [photograph(LENS, pose) for pose in walk(40)]


@pytest.fixture(scope="module")
def video(pictures: list[np.ndarray], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three frames at rest first, one in five blurred."""
    path = tmp_path_factory.mktemp("video") / "walk.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 30.0, (LENS.width, LENS.height))  # type: ignore[attr-defined]
    for i, picture in enumerate([pictures[0]] * 3 + pictures):
        image = cv2.GaussianBlur(picture, (0, 0), 4.0) if i % 5 == 4 else picture
        writer.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    writer.release()
    return path


def errors(root: Path, truth: dict[str, np.ndarray]) -> tuple[float, float]:
    """Greatest errors of a dataset's cameras, in degrees and metres, after the similarity that fits best."""
    found = {Path(r.name).stem: r.cam_from_object for r in load_dataset(root, "all").images}
    assert found.keys() <= truth.keys()
    ours, theirs = np.stack(list(found.values())), np.stack([truth[name] for name in found])
    aligned = align(ours, theirs).of_poses(ours)
    turned = [rotation_error_deg(a, b) for a, b in zip(aligned, theirs, strict=True)]
    return max(turned), float(np.linalg.norm(camera_centres(aligned) - camera_centres(theirs), axis=1).max())


def test_a_video_becomes_a_dataset(video: Path, tmp_path: Path) -> None:
    out, figures = tmp_path / "room", tmp_path / "figures.json"
    ran = fieldpose("capture", video, "--out", out, "--json", figures, "--threads", 2, cwd=tmp_path, timeout_s=120)
    assert ran.returncode == 0, ran.stderr
    told = json.loads(figures.read_text())
    assert told["seen"] == 43
    assert told["images"] >= 25
    assert all(int(Path(name).stem) % 5 == 4 for name in told["reasons"])
    assert told["metres_per_unit"] is None
    # The walk is along walls: nothing stands apart.
    assert told["object_aabb"] is None
    assert f"{told['images']} of {told['chosen']} images have a camera (of 43 seen" in ran.stdout
    truth = {f"{i:05d}": pose for i, pose in enumerate([walk(40)[0]] * 3 + list(walk(40)))}
    degrees, length = errors(out, truth)
    assert degrees < 0.5
    assert length < 0.04
    names = {path.stem for path in (out / "images").iterdir()}
    assert len(names & {"00000", "00001", "00002"}) == 1
    camera = read_camera_file(out / CAMERA_FILE)
    assert camera.fx == pytest.approx(400, rel=0.06)
    dataset = load_dataset(out, "test")
    assert 0 < len(dataset) <= len(names) / 8
    assert dataset.images[0].camera == camera
    again = fieldpose("capture", video, "--out", out, cwd=tmp_path)
    assert again.returncode == 2
    assert "not empty" in again.stderr


def test_photographs_are_turned_upright_once_and_copies_are_left_out(
    pictures: list[np.ndarray], tmp_path: Path
) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    for i, picture in enumerate(pictures[::3]):
        image = Image.fromarray(np.ascontiguousarray(np.rot90(picture)) if i == 4 else picture)
        exif = image.getexif()
        if i == 4:
            exif[ORIENTATION] = 6
        image.save(folder / f"p{i:02d}.jpg", quality=97, exif=exif)
    (folder / "copy.jpg").write_bytes((folder / "p03.jpg").read_bytes())
    Image.fromarray(pictures[-1]).save(folder / "p00.png")
    (folder / "._p00.jpg").write_bytes(b"of a Mac")
    told: list[str] = []
    captured = capture(str(folder), tmp_path / "room", 150, 400, 2, lambda what, share: told.append(what))
    assert captured.chosen == 15
    assert captured.images == 15
    assert captured.seen == 16
    assert (captured.camera.width, captured.camera.height) == (400, 300)
    truth = {f"p{i:02d}": pose for i, pose in enumerate(walk(40)[::3])}
    truth |= {"copy": walk(40)[9], "p00.jpg": walk(40)[0], "p00.png": walk(40)[-1]}
    degrees, length = errors(tmp_path / "room", truth)
    assert degrees < 0.5
    assert length < 0.04
    assert list(dict.fromkeys(told))[-1] == "writing the images"


def test_what_cannot_be_mapped_is_told_and_nothing_written(tmp_path: Path) -> None:
    grey = tmp_path / "grey"
    grey.mkdir()
    for i in range(10):
        Image.fromarray(np.full((120, 160, 3), 100 + i, np.uint8)).save(grey / f"{i}.png")
    with pytest.raises(DatasetError, match=r"only 0 of 10 .*too little texture.*newspaper"):
        capture(str(grey), tmp_path / "out", 150, 400, 1)
    assert not (tmp_path / "out").exists()
    with pytest.raises(SourceError, match="no images"):
        capture(str(tmp_path), tmp_path / "out", 150, 400, 1)
    with pytest.raises(SourceError, match="no such video"):
        capture(str(tmp_path / "none.mp4"), tmp_path / "out", 150, 400, 1)
    Image.fromarray(np.zeros((100, 160, 3), np.uint8)).save(grey / "other.png")
    with pytest.raises(SourceError, match=r"several sizes \(160x100, 160x120\)"):
        capture(str(grey), tmp_path / "out", 150, 400, 1)


def test_few_images_are_refused(pictures: list[np.ndarray], tmp_path: Path) -> None:
    for i, picture in enumerate(pictures[:4]):
        Image.fromarray(picture).save(tmp_path / f"{i}.png")
    ran = fieldpose("capture", tmp_path, "--out", tmp_path / "out", cwd=tmp_path)
    assert ran.returncode == 2
    assert "images 4 can be used, but at least 8 are needed" in ran.stderr
    assert not (tmp_path / "out" / "images").exists()


def test_images_without_a_place_are_named_with_the_reason(tmp_path: Path) -> None:
    poses = cameras_before_a_wall(LENS, 12).cam_from_object
    for i, pose in enumerate(poses):
        Image.fromarray(photograph(LENS, pose)).save(tmp_path / f"p{i:02d}.png")
    Image.fromarray(np.full((360, 480, 3), 90, np.uint8)).save(tmp_path / "wall.png")
    noise = np.random.default_rng(0).integers(0, 256, (360, 480, 3)).astype(np.uint8)
    Image.fromarray(cv2.GaussianBlur(noise, (0, 0), 1.0)).save(tmp_path / "z.png")
    captured = capture(str(tmp_path), tmp_path / "out", 150, 480, 2)
    assert captured.images == 12
    assert captured.reasons["wall.jpg"] == TOO_LITTLE
    assert captured.reasons["z.jpg"] == NO_OVERLAP
    assert summary(captured.reasons) == f"1 {TOO_LITTLE}, 1 {NO_OVERLAP}"
    assert advice({"a": TOO_LITTLE, "b": NO_OVERLAP, "c": NO_OVERLAP}).startswith("film the way")


def test_a_marker_gives_frame_and_metres(tmp_path: Path) -> None:
    for i, pose in enumerate(walk(24)):
        image = with_marker(photograph(LENS, pose), LENS, pose)
        Image.fromarray(image).save(tmp_path / f"p{i:02d}.png")
    ran = fieldpose(
        "capture", tmp_path, "--out", tmp_path / "out", "--marker", SIZE, "--threads", 2, cwd=tmp_path, timeout_s=120
    )
    assert ran.returncode == 0, ran.stderr
    assert "frame and metres are those of marker 7, which" in ran.stdout
    dataset = load_dataset(tmp_path / "out", "all")
    assert dataset.metres_per_unit == 1.0
    truth = np.stack([walk(24)[int(Path(r.name).stem[1:])] for r in dataset.images])
    apart = camera_centres(np.stack([r.cam_from_object for r in dataset.images]))
    there = camera_centres(truth) - MIDDLE
    np.testing.assert_allclose(apart, np.stack([there @ RIGHT, there @ UP, -there[:, 0]], axis=1), atol=0.06)
    ran = fieldpose(
        "capture", tmp_path, "--out", tmp_path / "b", "--marker", "0.1", "--family", "tag36h11", cwd=tmp_path
    )
    assert ran.returncode == 2
    assert "no marker of family tag36h11 was placed: 0 of" in ran.stderr
    assert not (tmp_path / "b" / "images").exists()


@pytest.mark.parametrize("ends_by", ["time", "Ctrl-C"])
def test_a_live_camera_films_until_the_time_is_over_or_ctrl_c(
    pictures: list[np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ends_by: str
) -> None:
    now, preview, shown = 0.0, tmp_path / "out.filming.jpg", list[tuple[int, ...]]()

    def film(first: int) -> Iterator[CapturedFrame]:
        nonlocal now
        for i in count():
            if ends_by == "Ctrl-C" and i == len(pictures):
                raise KeyboardInterrupt
            now += 0.1
            if preview.exists():
                shown.append(cv2.imread(str(preview)).shape)
            yield CapturedFrame(i, pictures[min(i, len(pictures) - 1)], "rgb8", LENS, f"{i}")

    monkeypatch.setattr(shots, "open_source", lambda config: Source("camera:0", "wall", film))
    monkeypatch.setattr(shots.time, "monotonic", lambda: now)
    told: list[str] = []
    captured = capture("camera:0", tmp_path / "out", 150, 400, 2, lambda what, share: told.append(what), seconds=6.0)
    # It grows by rows of what has been covered, and is gone when that is over.
    assert len(shown) > 5
    assert shown[0][1] > 900
    assert not preview.exists()
    assert any("frames kept, 0 blurred" in what for what in told)
    assert captured.images >= 25
    assert captured.seen == (len(pictures) if ends_by == "Ctrl-C" else pytest.approx(60, abs=1))


def test_photographs_of_two_lenses_and_what_is_not_read_are_named(
    pictures: list[np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "IMG_1.HEIC").write_bytes(b"not read")
    with pytest.raises(SourceError, match=r"no images .*1 files were not read, as IMG_1\.HEIC; convert them"):
        capture(str(tmp_path), tmp_path / "out", 150, 400, 1)
    for i, picture in enumerate(pictures[::3]):
        exif = Image.Exif()
        exif.get_ifd(0x8769)[0xA405] = 26 if i else 13
        Image.fromarray(picture).save(tmp_path / f"{i:02d}.jpg", exif=exif)
    with pytest.raises(SourceError, match="photographs of several lenses"):
        capture(str(tmp_path), tmp_path / "out", 150, 400, 1)
    (tmp_path / "00.jpg").unlink()
    captured = capture(str(tmp_path), tmp_path / "out", 150, 400, 2)
    assert captured.notes == ("1 files were not read, as IMG_1.HEIC; convert them to JPEG",)
    with pytest.raises(SourceError, match="expected a video, a camera, a recording or a folder"):
        capture(f"dataset:{tmp_path / 'out'}:train", tmp_path / "again", 150, 400, 1)
    assert main(["capture", str(tmp_path), "--out", str(tmp_path / "b"), "--most", "6"]) == 2
    assert "--most must be at least 16" in capsys.readouterr().err


def test_a_lens_that_folds_the_corners_over_is_refused_before_anything_is_written(
    pictures: list[np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for i, picture in enumerate(pictures[::4]):
        Image.fromarray(picture).save(tmp_path / f"{i:02d}.png")
    wide = Camera(400, 300, 220.0, 220.0, 199.5, 149.5, (-0.5, 0.0, 0.0, 0.0, 0.0))
    mapped = Mapped(np.arange(10), wide, walk(10), np.zeros((0, 3)), np.zeros(10, int), 0.3)
    monkeypatch.setattr(capturing.Structure, "map", lambda self: mapped)
    with pytest.raises(DatasetError, match=r"folds the images' corners over .*linear mode"):
        capture(str(tmp_path), tmp_path / "out", 150, 400, 1)
    assert not (tmp_path / "out").exists()


def test_a_video_that_is_cut_off_is_told(
    pictures: list[np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def film(first: int) -> Iterator[CapturedFrame]:
        yield from (CapturedFrame(i, picture, "rgb8", LENS, f"{i}") for i, picture in enumerate(pictures))

    for length, notes in ((41, ()), (100, ("only 40 of 100 frames could be read: is the file whole?",))):
        source = Source("video", "own", film, length)
        monkeypatch.setattr(shots, "open_source", lambda config, source=source: source)
        assert capture("mcap:a", tmp_path / f"{length}", 150, 400, 2).notes == notes


def test_cameras_that_cannot_be_adjusted_stay_as_mapped_and_that_is_told(
    pictures: list[np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def none(*arguments: object) -> None:
        raise GeometryError("no camera")

    for i, picture in enumerate(pictures[::3]):
        Image.fromarray(picture).save(tmp_path / f"{i:02d}.png")
    monkeypatch.setattr("fieldpose.stages.structure.adjustment.adjust", none)
    captured = capture(str(tmp_path), tmp_path / "out", 150, 400, 2)
    assert captured.images == 14
    assert captured.notes == ("the cameras are as they were mapped, since adjusting them all found none (no camera)",)


def on_a_turntable(count: int) -> tuple[list[np.ndarray], np.ndarray, list[np.ndarray]]:
    """Images of what turns before a camera that stands still, a mask of that, and its poses.

    What turns fills the middle; around it is the same in all images, with more texture.
    """
    rng, poses = np.random.default_rng(0), list(walk(count))
    around = cv2.resize(rng.integers(0, 255, (90, 120, 3), np.uint8), (LENS.width, LENS.height), cv2.INTER_CUBIC)
    rows, columns = np.mgrid[: LENS.height, : LENS.width]
    inside = np.hypot((columns - 240) / 235, (rows - 180) / 175) < 1
    return [np.where(inside[..., None], photograph(LENS, pose), around) for pose in poses], inside, poses


def test_masks_keep_what_does_not_turn_along_out(tmp_path: Path) -> None:
    images, inside, poses = on_a_turntable(20)
    photos, masks = tmp_path / "photos", tmp_path / "masks"
    photos.mkdir()
    for i, image in enumerate(images):
        cv2.imwrite(str(photos / f"{i:02d}.jpg"), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    masks.mkdir()
    for i in range(20):
        cv2.imwrite(str(masks / f"{i:02d}.png"), inside.astype(np.uint8) * 255)
    captured = capture(str(photos), tmp_path / "out", 150, 480, 2)
    assert captured.images >= 16
    truth = {f"{i:02d}": pose for i, pose in enumerate(poses)}
    degrees, length = errors(tmp_path / "out", truth)
    assert degrees < 1.0
    assert length < 0.08
    dataset = load_dataset(tmp_path / "out", "all")
    learnt = dataset.load_learnt(0)
    np.testing.assert_array_equal(learnt, inside)
    assert load_dataset(tmp_path / "out", "all", cut_out=True).scene == "object"
    (masks / "03.png").unlink()
    with pytest.raises(DatasetError, match=r"1 of 20 images have no mask there: .*03\.jpg"):
        capture(str(photos), tmp_path / "other", 150, 480, 2)
    cv2.imwrite(str(masks / "03.png"), np.zeros((48, 48), np.uint8))
    with pytest.raises(SourceError, match=r"48x48 pixels, 03\.jpg, upright as its EXIF says, 480x360, another shape"):
        capture(str(photos), tmp_path / "other", 150, 480, 2)


def test_what_is_transparent_is_not_looked_at_and_stays_transparent(tmp_path: Path) -> None:
    """One photograph has no alpha channel, and one edge is half transparent."""
    images, inside, _ = on_a_turntable(20)
    (tmp_path / "photos").mkdir()
    alpha = np.where(inside, 255, 0).astype(np.uint8)
    alpha[170:190, 230:250] = 128
    for i, image in enumerate(images):
        pixels = np.dstack([cv2.cvtColor(image, cv2.COLOR_RGB2BGR), alpha])
        cv2.imwrite(str(tmp_path / "photos" / f"{i:02d}.png"), pixels[..., :3] if i == 0 else pixels)
    assert capture(str(tmp_path / "photos"), tmp_path / "out", 150, 480, 2).images >= 16
    dataset = load_dataset(tmp_path / "out", "all")
    assert (dataset.scene, dataset.has_alpha) == ("object", True)
    named = {record.name: i for i, record in enumerate(dataset.images)}
    shown = dataset.load_image(named["images/05.png"])
    np.testing.assert_array_equal(shown[..., 3], alpha)
    np.testing.assert_array_equal(shown[inside, :3], images[5][inside])
    assert (dataset.load_image(named["images/00.png"])[..., 3] == 255).all()
