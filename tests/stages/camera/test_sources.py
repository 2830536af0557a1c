"""Sources read from real files: what comes out, in what order, with which camera and when."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from support.posed_images import CAMERA, write_blender, write_transforms

from fieldpose.bus.messages import CameraOrigin, Frame, Truth
from fieldpose.bus.node import first_header
from fieldpose.bus.recording import RecordingWriter
from fieldpose.bus.topics import FRAME, TRUTH, Address
from fieldpose.errors import DatasetError, SourceError
from fieldpose.stages.camera.config import CameraConfig
from fieldpose.stages.camera.core import CapturedFrame
from fieldpose.stages.camera.sources import KINDS, is_video, open_source
from fieldpose.stages.geometry import Camera, look_at

MS = 1_000_000


def frames_of(source: object, first: int = 0, **config: object) -> list[CapturedFrame]:
    return list(open_source(CameraConfig(str(source), **config)).frames(first))  # type: ignore[arg-type]


def shade(value: int, width: int = 48, height: int = 32) -> np.ndarray:
    """A picture whose red tells its number, brighter to the right."""
    image = np.zeros((height, width, 3), np.uint8)
    image[..., 0] = value
    image[..., 1] = np.linspace(0, 255, width).astype(np.uint8)
    return image


def decoded(frame: CapturedFrame) -> np.ndarray:
    if frame.encoding == "rgb8":
        return frame.image
    return cv2.cvtColor(cv2.imdecode(frame.image, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    root = tmp_path / "photos"
    root.mkdir()
    for name, value in (("img10.png", 100), ("img2.jpg", 20), ("img1.png", 10)):
        Image.fromarray(shade(value)).save(root / name, quality=95)
    (root / "notes.txt").write_text("no image")
    return root


def test_a_folder_comes_in_natural_order_and_jpegs_stay_as_they_are(folder: Path) -> None:
    frames = frames_of(f"folder:{folder}")
    assert [frame.name for frame in frames] == ["img1.png", "img2.jpg", "img10.png"]
    assert [frame.encoding for frame in frames] == ["rgb8", "jpeg", "rgb8"]
    assert frames[1].image.tobytes() == (folder / "img2.jpg").read_bytes()
    for frame, value in zip(frames, (10, 20, 100), strict=True):
        assert decoded(frame)[..., 0].mean() == pytest.approx(value, abs=3)
        assert decoded(frame).shape == (frame.camera.height, frame.camera.width, 3)
    assert [frame.frame_id for frame in frames_of(f"folder:{folder}", first=1)] == [1, 2]


def test_images_are_shrunk_with_their_camera(folder: Path) -> None:
    full, small = frames_of(f"folder:{folder}")[1], frames_of(f"folder:{folder}", size=24)[1]
    assert (small.encoding, small.image.shape) == ("rgb8", (16, 24, 3))
    assert (small.camera.width, small.camera.height) == (24, 16)
    assert small.camera.fx == pytest.approx(full.camera.fx / 2)
    assert small.camera.cx == pytest.approx((full.camera.cx + 0.5) / 2 - 0.5)


def test_transparency_is_laid_over_white(tmp_path: Path) -> None:
    clear = np.zeros((8, 8, 4), np.uint8)
    Image.fromarray(clear).save(tmp_path / "clear.png")
    assert frames_of(f"folder:{tmp_path}")[0].image.min() == 255


def with_exif(path: Path, tag: int, value: int, ifd: int | None = None) -> None:
    exif = Image.Exif()
    (exif if ifd is None else exif.get_ifd(ifd))[tag] = value
    Image.fromarray(shade(5)).save(path, exif=exif)


def corner(frame: CapturedFrame) -> tuple[int, int]:
    """Row and column of the brightest pixel."""
    image = decoded(frame).astype(int).sum(axis=2)
    row, column = np.unravel_index(int(image.argmax()), image.shape)
    return int(row), int(column)


@pytest.mark.parametrize(("known", "turned"), [(None, True), ((64, 96), True), ((96, 64), False)])
def test_a_photo_is_turned_as_exif_says_but_where_only_its_stored_shape_is_known(
    tmp_path: Path, known: tuple[int, int] | None, turned: bool
) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    pixels = shade(5)
    pixels[2:5, 3:6] = 255
    Image.fromarray(pixels).save(tmp_path / "turned.png", exif=exif)
    cameras = [] if known is None else [Camera(*known, 80.0, 80.0, (known[0] - 1) / 2, (known[1] - 1) / 2)]
    frame = next(open_source(CameraConfig(f"folder:{tmp_path}"), cameras).frames(0))
    assert frame.image.shape == ((48, 32, 3) if turned else (32, 48, 3))
    assert (frame.camera.width, frame.camera.height) == frame.image.shape[1::-1]
    assert corner(frame) == ((3, 27) if turned else (2, 3))
    assert (frame.origin is CameraOrigin.TRAINING) == (known is not None)


def test_grey_values_of_sixteen_bits_are_scaled(tmp_path: Path) -> None:
    levels = np.linspace(0, 65535, 48 * 32).reshape(32, 48).astype(np.uint16)
    Image.fromarray(levels).save(tmp_path / "deep.png")
    image = frames_of(f"folder:{tmp_path}")[0].image
    np.testing.assert_allclose(image[..., 0], levels / 257, atol=0.51)
    assert (image[..., 0] == image[..., 2]).all()


def test_the_focal_length_comes_from_exif_then_from_the_field_of_view(tmp_path: Path) -> None:
    with_exif(tmp_path / "a.jpg", 0xA405, 26, ifd=0x8769)
    source = open_source(CameraConfig(f"folder:{tmp_path}", fov_deg=90))
    assert "EXIF" in source.description
    assert next(source.frames(0)).camera.fx == pytest.approx(26 * np.hypot(48, 32) / np.hypot(36, 24))
    Image.fromarray(shade(5)).save(tmp_path / "a.jpg")
    source = open_source(CameraConfig(f"folder:{tmp_path}", fov_deg=90))
    assert "90 degrees" in source.description
    camera = next(source.frames(0)).camera
    assert (camera.fx, camera.fy) == (pytest.approx(24.0), pytest.approx(24.0))
    assert (camera.cx, camera.cy) == (23.5, 15.5)


def camera_file(path: Path, **changes: object) -> Path:
    known = {
        "width": 96,
        "height": 64,
        "fx": 100,
        "fy": 101,
        "cx": 47.5,
        "cy": 31.5,
        "distortion": [0.1, 0, 0, 0, 0],
    }
    path.write_text(json.dumps({name: value for name, value in (known | changes).items() if value is not None}))
    return path


def test_a_camera_file_overrides_and_is_scaled_to_the_images(folder: Path, tmp_path: Path) -> None:
    config = CameraConfig(f"folder:{folder}", camera_file=camera_file(tmp_path / "camera.json"))
    for known in ([], [Camera(96, 64, 80.0, 81.0, 47.0, 32.0)]):
        frame = next(open_source(config, known).frames(0))
        assert frame.camera == Camera(48, 32, 50.0, 50.5, 23.5, 15.5, (0.1, 0, 0, 0, 0))
        assert frame.origin is CameraOrigin.CALIBRATED


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"fx": None}, "fx"),
        ({"fx": -1}, "positive"),
        ({"focal": 3}, "focal"),
        ({"distortion": [1]}, "distortion"),
        ({"width": 64}, "another shape"),
    ],
)
def test_a_bad_camera_file_is_named(folder: Path, tmp_path: Path, changes: dict, complaint: str) -> None:
    path = camera_file(tmp_path / "camera.json", **changes)
    with pytest.raises(SourceError, match=complaint) as caught:
        frames_of(f"folder:{folder}", camera_file=path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    with pytest.raises(SourceError, match="no such camera file"):
        frames_of(f"folder:{folder}", camera_file=tmp_path / "none.json")


def test_every_image_of_a_folder_tells_where_its_own_camera_is_from(tmp_path: Path) -> None:
    Image.fromarray(shade(5)).save(tmp_path / "0.jpg")
    with_exif(tmp_path / "1.jpg", 0xA405, 60, ifd=0x8769)
    Image.fromarray(shade(5)).save(tmp_path / "2.png")
    Image.fromarray(shade(5, 32, 32)).save(tmp_path / "3.png")
    known = [Camera(96, 64, 80.0, 81.0, 47.0, 32.0)]
    source = open_source(CameraConfig(f"folder:{tmp_path}"), known)
    assert "training views" in source.description
    frames = list(source.frames(0))
    training, exif, assumed = CameraOrigin.TRAINING, CameraOrigin.EXIF, CameraOrigin.ASSUMED
    assert [frame.origin for frame in frames] == [training, exif, training, assumed]
    assert [frame.encoding for frame in frames] == ["jpeg", "jpeg", "rgb8", "rgb8"]
    assert frames[0].camera == frames[2].camera == known[0].resized(48, 32)
    assert frames[1].camera.fx == pytest.approx(80.0)


def test_a_training_camera_is_shrunk_with_the_image(folder: Path) -> None:
    known = [Camera(96, 64, 80.0, 81.0, 47.0, 32.0)]
    frame = next(open_source(CameraConfig(f"folder:{folder}", size=24), known).frames(0))
    assert frame.origin is CameraOrigin.TRAINING
    assert frame.camera == known[0].resized(24, 16)


def test_a_dataset_knows_its_cameras_and_is_told_none(tmp_path: Path) -> None:
    write_transforms(tmp_path, CAMERA, count=9)
    known = [Camera(96, 64, 80.0, 81.0, 47.0, 32.0)]
    frame = next(open_source(CameraConfig(f"dataset:{tmp_path}:test"), known).frames(0))
    assert (frame.camera.fx, frame.origin) == (CAMERA.fx, CameraOrigin.CALIBRATED)


def test_a_dataset_split_comes_with_its_true_poses(tmp_path: Path) -> None:
    poses = write_blender(tmp_path, CAMERA.resized(64, 64), counts=(4, 2))
    frames = frames_of(f"dataset:{tmp_path}:test")
    assert len(frames) == 2
    for frame, pose in zip(frames, poses[4:], strict=True):
        assert frame.truth is not None
        np.testing.assert_allclose(frame.truth.cam_from_object, pose, atol=1e-6)
        assert (frame.encoding, frame.image.shape) == ("rgb8", (64, 64, 3))
        assert frame.image[0, 0].min() == 255
    assert [frame.name for frame in frames_of(f"dataset:{tmp_path}")] == [frame.name for frame in frames]
    assert len(frames_of(f"dataset:{tmp_path}:all", size=32)) == 6


def test_size_and_holdout_reach_the_dataset(tmp_path: Path) -> None:
    write_transforms(tmp_path, CAMERA, count=9)
    assert [frame.name for frame in frames_of(f"dataset:{tmp_path}:test", holdout="every8")] == [
        "images/0000.png",
        "images/0008.png",
    ]
    frame = frames_of(f"dataset:{tmp_path}:test", size=48)[0]
    assert (frame.camera.width, frame.image.shape) == (48, (32, 48, 3))


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("video") / "clip.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 25.0, (48, 32))
    for i in range(10):
        writer.write(cv2.cvtColor(shade(20 * i), cv2.COLOR_RGB2BGR))
    writer.release()
    return path


def test_a_video_comes_with_the_times_of_its_frames(video: Path) -> None:
    source = open_source(CameraConfig(f"video:{video}"))
    frames = list(source.frames(0))
    assert (source.clock, source.length, len(frames)) == ("own", 10, 10)
    assert "25 frames a second" in source.description
    times = np.array([frame.at_ns for frame in frames]) / MS
    np.testing.assert_allclose(np.diff(times), 40, atol=1)
    for i, frame in enumerate(frames):
        assert frame.image[..., 0].mean() == pytest.approx(20 * i, abs=8)
        assert frame.image[..., 2].mean() < 40
    assert [frame.at_ns for frame in source.frames(7)] == [frame.at_ns for frame in frames[7:]]


def test_a_device_is_read_with_the_time_of_day(video: Path) -> None:
    source = open_source(CameraConfig(f"camera:{video}"))
    frames = []
    with pytest.raises(SourceError, match=r"gives no more frames; is it still plugged in\?"):
        frames.extend(each for each in source.frames(5))
    assert source.clock == "wall"
    assert [frame.frame_id for frame in frames[:2]] == [5, 6]
    assert frames[0].at_ns is not None
    assert frames[0].at_ns > 1.6e18


@pytest.mark.parametrize("kind", ["video", "camera"])
def test_videos_and_devices_take_the_training_camera_of_their_shape(video: Path, kind: str) -> None:
    for camera, origin in (
        (Camera(96, 64, 80.0, 81.0, 47.0, 32.0), CameraOrigin.TRAINING),
        (Camera(64, 96, 80.0, 81.0, 32.0, 47.0), CameraOrigin.ASSUMED),
    ):
        source = open_source(CameraConfig(f"{kind}:{video}", size=24), [camera])
        frame = next(source.frames(0))
        assert frame.origin is origin
        if origin is CameraOrigin.TRAINING:
            assert frame.camera == camera.resized(24, 16)
            assert "training views" in source.description
        else:
            assert "60 degrees" in source.description


def record(
    path: Path, order: list[tuple[str, int]], camera: str = "camera0", encoding: str = "rgb8",
    origin: CameraOrigin = CameraOrigin.CALIBRATED,
) -> Path:  # fmt: skip
    writer = RecordingWriter(path)
    address = Address(camera=camera)
    for i, (kind, frame_id) in enumerate(order):
        header = first_header(frame_id, 5_000 * MS + frame_id * 33 * MS)
        if kind == "truth":
            pose = look_at((4, 0.1 * frame_id, 1), (0, 0, 0), (0, 0, 1)) if frame_id % 5 else None
            writer.write(address.key(TRUTH), TRUTH, Truth(header=header, cam_from_object=pose), i)
            continue
        image = shade(frame_id)
        if encoding == "jpeg":
            image = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1]
        model = Camera(48, 32, 50.0, 50.0, 23.5, 15.5)
        frame = Frame(
            header=header,
            image=image,
            encoding=encoding,  # type: ignore[arg-type]
            camera=model,
            camera_origin=origin,
        )
        writer.write(address.key(FRAME), FRAME, frame, i)
    writer.close()
    return path


def test_a_recording_comes_with_its_numbers_times_and_truths(tmp_path: Path) -> None:
    order = [("truth", 3), ("frame", 3), ("frame", 4), ("truth", 4), ("frame", 5), ("frame", 7), ("truth", 5)]
    frames = frames_of(f"mcap:{record(tmp_path / 'a.mcap', order)}")
    assert [frame.frame_id for frame in frames] == [3, 4, 5, 7]
    times = np.array([frame.at_ns for frame in frames])
    np.testing.assert_array_equal(np.diff(times), [33 * MS, 33 * MS, 66 * MS])
    assert [frame.truth is not None for frame in frames] == [True, True, True, False]
    assert frames[0].truth.cam_from_object is not None  # type: ignore[union-attr]
    assert frames[2].truth.cam_from_object is None  # type: ignore[union-attr]
    np.testing.assert_array_equal(frames[3].image, shade(7))
    assert [f.frame_id for f in frames_of(f"mcap:{tmp_path / 'a.mcap'}", first=2)] == [5, 7]


def test_frames_that_were_not_counted_are_numbered_on(tmp_path: Path) -> None:
    order = [("frame", 4), ("frame", 4), ("frame", 9), ("frame", 4), ("frame", 10)]
    frames = frames_of(f"mcap:{record(tmp_path / 'a.mcap', order)}")
    assert [frame.frame_id for frame in frames] == [4, 5, 9, 10, 11]
    assert len({frame.name for frame in frames}) == 5


def test_recorded_images_stay_encoded_unless_they_are_shrunk(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", [("frame", 60)], encoding="jpeg")
    assert frames_of(f"mcap:{path}")[0].encoding == "jpeg"
    small = frames_of(f"mcap:{path}", size=24)[0]
    assert (small.encoding, small.image.shape, small.camera.fx) == ("rgb8", (16, 24, 3), 25.0)
    assert small.image[..., 0].mean() == pytest.approx(60, abs=4)


@pytest.mark.parametrize("size", [None, 24])
@pytest.mark.parametrize("origin", list(CameraOrigin))
def test_a_recording_remembers_where_its_camera_is_from(tmp_path: Path, origin: CameraOrigin, size: int | None) -> None:
    path = record(tmp_path / "a.mcap", [("frame", 0)], origin=origin)
    known = [Camera(96, 64, 80.0, 81.0, 47.0, 32.0)]
    frame = next(open_source(CameraConfig(f"mcap:{path}", size=size), known).frames(0))
    assert (frame.origin, frame.camera.fx) == (origin, 50.0 if size is None else 25.0)


def test_a_recording_of_two_cameras_is_not_mixed(tmp_path: Path) -> None:
    path = record(tmp_path / "one.mcap", [("frame", 0)])
    writer = RecordingWriter(tmp_path / "two.mcap")
    for i, camera in enumerate(("left", "right")):
        model = Camera(48, 32, 50.0, 50.0, 23.5, 15.5)
        frame = Frame(header=first_header(i, i), image=shade(0), encoding="rgb8", camera=model)
        writer.write(Address(camera=camera).key(FRAME), FRAME, frame, i)
    writer.close()
    assert len(frames_of(f"mcap:{path}")) == 1
    two = f"mcap:{tmp_path / 'two.mcap'}"
    with pytest.raises(SourceError, match=r"choose one with --camera\.recorded OBJECT/CAMERA"):
        frames_of(two)
    assert [frame.frame_id for frame in frames_of(two, recorded="object/right")] == [1]
    wrongs = {"object/back": "no camera frames of object/back", "right": "expected OBJECT/CAMERA"}
    for wrong, complaint in wrongs.items():
        with pytest.raises(SourceError, match=complaint):
            frames_of(two, recorded=wrong)


def test_a_recording_of_two_objects_gives_the_truths_of_the_one_that_is_chosen(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "a.mcap")
    camera, header = Camera(48, 32, 50.0, 50.0, 23.5, 15.5), first_header(0, 0)
    writer.write(Address().key(FRAME), FRAME, Frame(header=header, image=shade(0), encoding="rgb8", camera=camera), 0)
    for shift, name in enumerate(("lamp", "can")):
        pose = np.eye(4)
        pose[2, 3] = 1 + shift
        writer.write(Address(object=name).key(TRUTH), TRUTH, Truth(header=header, cam_from_object=pose), 0)
    writer.close()
    for name, depth in (("lamp", 1), ("can", 2)):
        (frame,) = frames_of(f"mcap:{tmp_path / 'a.mcap'}", recorded=f"{name}/camera0")
        assert frame.truth is not None
        assert frame.truth.cam_from_object is not None
        assert frame.truth.cam_from_object[2, 3] == depth
    (frame,) = frames_of(f"mcap:{tmp_path / 'a.mcap'}", recorded="cup/camera0")
    assert frame.truth is None


def broken_sources(root: Path) -> dict[str, tuple[str, str]]:
    (root / "empty").mkdir()
    (root / "words").mkdir()
    (root / "words" / "a.png").write_text("no image at all")
    (root / "text.mp4").write_text("no video at all")
    (root / "text.mcap").write_text("no recording at all")
    RecordingWriter(root / "silent.mcap").close()
    return {
        "unknown kind": ("webcam:0", "folder:DIR, dataset:DIR:test, video:FILE, camera:0, mcap:FILE"),
        "no kind": ("photos", "expected one of"),
        "nothing after the colon": ("folder:", "expected one of"),
        "missing folder": (f"folder:{root / 'none'}", "no such folder"),
        "empty folder": (f"folder:{root / 'empty'}", "no images"),
        "not an image": (f"folder:{root / 'words'}", "a.png"),
        "missing video": (f"video:{root / 'none.mp4'}", "no such video"),
        "not a video": (f"video:{root / 'text.mp4'}", "text.mp4: not a video"),
        "no such device": ("camera:987", "no such camera"),
        "missing recording": (f"mcap:{root / 'none.mcap'}", "none.mcap"),
        "not a recording": (f"mcap:{root / 'text.mcap'}", "no recording"),
        "recording without frames": (f"mcap:{root / 'silent.mcap'}", "no camera frames"),
        "unknown split": (f"dataset:{root}:tests", "no split"),
    }


def test_what_cannot_be_opened_is_told_in_one_line(tmp_path: Path) -> None:
    for what, (source, complaint) in broken_sources(tmp_path).items():
        with pytest.raises(SourceError) as caught:
            open_source(CameraConfig(source))
        assert complaint in str(caught.value), what
        assert "\n" not in str(caught.value), what


def test_libraries_print_nothing_about_what_cannot_be_opened(tmp_path: Path) -> None:
    broken_sources(tmp_path)
    program = """
import sys
from fieldpose.stages.camera.config import CameraConfig
from fieldpose.stages.camera.sources import open_source
from fieldpose.errors import SourceError
for source in sys.argv[1:]:
    try:
        open_source(CameraConfig(source))
    except SourceError:
        print("refused")
"""
    command = [sys.executable, "-c", program, f"video:{tmp_path / 'text.mp4'}", "camera:987"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=Path(__file__).parents[3], check=True)
    assert (done.stdout, done.stderr) == ("refused\nrefused\n", "")


def test_a_dataset_that_is_none_is_an_error_of_the_dataset(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="no such folder"):
        open_source(CameraConfig(f"dataset:{tmp_path / 'none'}:test"))


def test_which_sources_are_videos() -> None:
    assert {name for name, kind in KINDS.items() if kind.is_video} == {"video", "camera", "mcap", "bag"}
    assert is_video("mcap:a.mcap")
    assert not is_video("folder:photos")


@pytest.mark.skipif(
    not (Path(__file__).parents[3].parent / "shared" / "data" / "fox").is_dir(), reason="no photographs here"
)
def test_real_photographs_as_a_dataset_and_as_a_folder() -> None:
    fox = Path(__file__).parents[3].parent / "shared" / "data" / "fox"
    source = open_source(CameraConfig(f"dataset:{fox}:test", size=320))
    frame = next(source.frames(3))
    assert source.length == 25
    assert max(frame.image.shape) == 320
    assert any(frame.camera.distortion)
    loose = next(open_source(CameraConfig(f"folder:{fox / 'images'}")).frames(0))
    assert loose.encoding == "jpeg"


def test_a_file_without_its_kind_is_told_which_it_is_likely_to_be(tmp_path: Path) -> None:
    for name, meant in (("film.mp4", "video"), ("run.mcap", "mcap"), ("robot.bag", "bag")):
        (tmp_path / name).write_bytes(b"")
        with pytest.raises(SourceError, match=re.escape(f"is {meant}:{tmp_path / name} meant?")):
            is_video(str(tmp_path / name))
    with pytest.raises(SourceError, match=re.escape(f"is folder:{tmp_path} meant?")):
        is_video(str(tmp_path))
    with pytest.raises(SourceError) as said:
        is_video("nowhere.mp4")
    assert "meant" not in str(said.value)
