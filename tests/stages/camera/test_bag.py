"""Bags of ROS 1 and 2, written by rosbags: their pixels, stamps and cameras, and what is refused."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from fieldpose.bus.foreign import ForeignWriter
from fieldpose.bus.messages import CameraOrigin
from fieldpose.bus.recording import RecordingWriter
from fieldpose.errors import SourceError
from fieldpose.stages.camera.config import CameraConfig
from fieldpose.stages.camera.core import CapturedFrame
from fieldpose.stages.camera.sources import is_video, knows_truth, open_source
from fieldpose.stages.geometry import Camera

KINDS = ("bag", "db3", "mcap", "folder")
STORES = {1: get_typestore(Stores.ROS1_NOETIC), 2: get_typestore(Stores.ROS2_JAZZY)}
BEGAN_NS = 1_700_000_000_123_456_789
WIDTH, HEIGHT = 8, 6
K = [10.0, 0.0, 3.6, 0.0, 11.0, 2.4, 0.0, 0.0, 1.0]
P = [9.0, 0.0, 3.1, -0.9, 0.0, 9.5, 2.2, 0.0, 0.0, 0.0, 1.0, 0.0]
D = [0.1, -0.05, 0.001, -0.002, 0.01]
RAW, INFO = "/front/image_raw", "/front/camera_info"

Sent = tuple[str, Any, int]


def types(ros: int) -> Any:
    return STORES[ros].types


def header(ros: int, at_ns: int) -> Any:
    stamp = types(ros)["builtin_interfaces/msg/Time"](at_ns // 10**9, at_ns % 10**9)
    number = {"seq": 0} if ros == 1 else {}
    return types(ros)["std_msgs/msg/Header"](stamp=stamp, frame_id="front", **number)


def image(
    pixels: np.ndarray, encoding: str = "rgb8", at_ns: int = BEGAN_NS, ros: int = 2, pad: int = 0, big: bool = False
) -> Any:
    rows = pixels.astype(pixels.dtype.newbyteorder(">" if big else "<")).reshape(len(pixels), -1).view(np.uint8)
    padded = np.pad(rows, ((0, 0), (0, pad)))
    return types(ros)["sensor_msgs/msg/Image"](
        header(ros, at_ns), pixels.shape[0], pixels.shape[1], encoding, int(big), padded.shape[1], padded.ravel()
    )


def compressed(data: bytes, kind: str, at_ns: int = BEGAN_NS, ros: int = 2) -> Any:
    return types(ros)["sensor_msgs/msg/CompressedImage"](header(ros, at_ns), kind, np.frombuffer(data, np.uint8))


def info(
    ros: int = 2, model: str = "plumb_bob", d: list[float] = D, k: list[float] = K,
    size: tuple[int, int] = (WIDTH, HEIGHT), bins: int = 0, roi: tuple[int, int, int, int] = (0, 0, 0, 0),
) -> Any:  # fmt: skip
    region = types(ros)["sensor_msgs/msg/RegionOfInterest"](*roi, False)
    matrices = {"d": np.array(d), "k": np.array(k), "r": np.eye(3).ravel(), "p": np.array(P)}
    named = {name.upper() if ros == 1 else name: value for name, value in matrices.items()}
    return types(ros)["sensor_msgs/msg/CameraInfo"](
        header=header(ros, BEGAN_NS), height=size[1], width=size[0], distortion_model=model, binning_x=bins,
        binning_y=bins, roi=region, **named,
    )  # fmt: skip


@contextmanager
def writer(path: Path, kind: str, compressed: CompressionMode | None = None) -> Iterator[Any]:
    if kind == "bag":
        with Writer1(path) as opened:
            yield opened
    else:
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        made = Writer2(path, version=9, storage_plugin=plugin)
        if compressed is not None:
            made.set_compression(compressed, CompressionFormat.ZSTD)
        with made as opened:
            yield opened


def bag(root: Path, sent: Iterable[Sent], kind: str = "mcap", compressed: CompressionMode | None = None) -> Path:
    """Messages on topics, each recorded at a time, in a bag of that kind."""
    ros, path = (1, root / "a.bag") if kind == "bag" else (2, root / "a")
    store = STORES[ros]
    with writer(path, kind, compressed) as out:
        connections: dict[str, Any] = {}
        for topic, message, at_ns in sent:
            name = message.__msgtype__
            if topic not in connections:
                connections[topic] = out.add_connection(topic, name, typestore=store)
            data = store.serialize_ros1(message, name) if ros == 1 else store.serialize_cdr(message, name)
            out.write(connections[topic], at_ns, data)
    return path if kind in ("bag", "folder") else next(path.glob(f"*.{kind}"))


def frames_of(path: Path | str, first: int = 0, **config: Any) -> list[CapturedFrame]:
    return list(open_source(CameraConfig(f"bag:{path}", **config)).frames(first))


def picture(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)


def one(root: Path, message: Any, **config: Any) -> CapturedFrame:
    (frame,) = frames_of(bag(root, [(RAW, message, BEGAN_NS)]), **config)
    return frame


@pytest.mark.parametrize("kind", KINDS)
def test_pixels_stamps_and_the_camera_of_a_bag_come_out(tmp_path: Path, kind: str) -> None:
    ros = 1 if kind == "bag" else 2
    stamps = [BEGAN_NS + i * 33_333_333 for i in range(3)]
    sent: list[Sent] = [(INFO, info(ros), BEGAN_NS)]
    # They are recorded later than they were taken.
    sent += [(RAW, image(picture(i), at_ns=at, ros=ros), at + 5_000_000) for i, at in enumerate(stamps)]
    path = bag(tmp_path, sent, kind)
    frames = frames_of(path)
    assert [frame.at_ns for frame in frames] == stamps
    assert [frame.frame_id for frame in frames] == [0, 1, 2]
    for i, frame in enumerate(frames):
        assert (frame.encoding, frame.origin) == ("rgb8", CameraOrigin.CALIBRATED)
        np.testing.assert_array_equal(frame.image, picture(i))
        assert frame.camera == Camera(WIDTH, HEIGHT, 10.0, 11.0, 3.6, 2.4, tuple(D))  # type: ignore[arg-type]
    assert [frame.at_ns for frame in frames_of(path, first=2)] == stamps[2:]
    source = open_source(CameraConfig(f"bag:{path}"))
    assert (source.clock, source.length) == ("own", 3)
    assert source.description == f"bag {path}, {RAW}, camera of {INFO}"
    assert is_video(f"bag:{path}")
    assert not knows_truth(f"bag:{path}")


def bayer(pattern: str, colours: np.ndarray, kind: type[np.generic] = np.uint8) -> np.ndarray:
    """What a sensor behind that pattern sees of an even colour."""
    cell = np.array(["rgb".index(letter) for letter in pattern]).reshape(2, 2)
    return np.tile(colours[cell], (HEIGHT // 2, WIDTH // 2)).astype(kind)


def yuv(order: str) -> tuple[np.ndarray, np.ndarray]:
    """Two bytes for each pixel of an even grey-blue, and what that is in RGB by ITU-R BT.601 of limited range."""
    y, u, v = 120, 150, 110
    grey, blue, red = 1.164 * (y - 16), u - 128, v - 128
    rgb = np.array([grey + 1.596 * red, grey - 0.813 * red - 0.392 * blue, grey + 2.017 * blue])
    pair = [u, y, v, y] if order == "uyvy" else [y, u, y, v]
    return np.tile(np.array(pair, np.uint8).reshape(2, 2), (HEIGHT, WIDTH // 2, 1)), rgb


COLOUR = np.array([200, 90, 30])


@pytest.mark.parametrize("pad", [0, 4])
@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "rgba8", "bgra8", "mono8", "mono16"])
def test_plain_encodings_are_converted(tmp_path: Path, encoding: str, pad: int) -> None:
    rgb = picture()
    grey = np.repeat(rgb[..., :1], 3, axis=2)
    alpha = np.full((HEIGHT, WIDTH, 1), 7, np.uint8)
    as_sent = {
        "rgb8": rgb,
        "bgr8": rgb[..., ::-1],
        "rgba8": np.dstack([rgb, alpha]),
        "bgra8": np.dstack([rgb[..., ::-1], alpha]),
        "mono8": rgb[..., :1],
        "mono16": rgb[..., :1].astype(np.uint16) * 256 + 99,
    }[encoding]
    expected = grey if encoding.startswith("mono") else rgb
    for big in (False, True):
        root = tmp_path / f"{big}"
        root.mkdir()
        frame = one(root, image(np.ascontiguousarray(as_sent), encoding, pad=pad, big=big))
        np.testing.assert_array_equal(frame.image, expected)


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_a_bayer_pattern_is_unfolded(tmp_path: Path, pattern: str) -> None:
    for bits, kind, factor in ((8, np.uint8, 1), (16, np.uint16, 256)):
        root = tmp_path / f"{bits}"
        root.mkdir()
        frame = one(root, image(bayer(pattern, COLOUR * factor, kind), f"bayer_{pattern}{bits}"))
        np.testing.assert_array_equal(frame.image[1:-1, 1:-1], np.broadcast_to(COLOUR, (HEIGHT - 2, WIDTH - 2, 3)))
    _, file = cv2.imencode(".png", bayer(pattern, COLOUR))
    root = tmp_path / "compressed"
    root.mkdir()
    frame = one(root, compressed(file.tobytes(), f"bayer_{pattern}8; png compressed "))
    assert (frame.encoding, tuple(frame.image[2, 2])) == ("rgb8", tuple(COLOUR))


@pytest.mark.parametrize("encoding", ["yuv422", "uyvy", "yuv422_yuy2", "yuyv"])
def test_yuv_is_converted(tmp_path: Path, encoding: str) -> None:
    pixels, rgb = yuv("uyvy" if encoding in ("yuv422", "uyvy") else "yuyv")
    frame = one(tmp_path, image(pixels, encoding))
    np.testing.assert_allclose(frame.image.reshape(-1, 3), np.broadcast_to(rgb, (HEIGHT * WIDTH, 3)), atol=1.5)


@pytest.mark.parametrize(("kind", "suffix"), [("jpeg", ".jpg"), ("png", ".png")])
def test_compressed_images_stay_as_they_are(tmp_path: Path, kind: str, suffix: str) -> None:
    data = cv2.imencode(suffix, picture())[1].tobytes()
    sent: list[Sent] = [(f"{RAW}/compressed", compressed(data, f"bgr8; {kind} compressed bgr8"), BEGAN_NS)]
    path = bag(tmp_path, [*sent, (INFO, info(), BEGAN_NS + 1)])
    (frame,) = frames_of(path)
    assert (frame.encoding, frame.image.tobytes()) == (kind, data)
    # The first camera is known for images before it as well.
    assert (frame.camera.fx, frame.origin) == (10.0, CameraOrigin.CALIBRATED)
    (small,) = frames_of(path, size=4)
    assert (small.encoding, small.image.shape, small.camera.width) == ("rgb8", (3, 4, 3), 4)
    assert small.camera.fx == pytest.approx(5.0)


@pytest.mark.parametrize(
    ("message", "said"),
    [
        (
            image(picture()[..., :1].astype(np.uint16), "16UC1"),
            "encoding '16UC1' is not supported; expected bayer_bggr16",
        ),
        (image(picture()[:, :7, :2], "yuv422"), "an image of 7x6 pixels cannot be of its encoding (sz.width % 2 == 0)"),
        (image(picture()[..., :2], "nv21"), "encoding 'nv21' is not supported"),
        (replace(image(picture()), step=5), "has 144 bytes in rows of 5; expected at least 6 rows of 24"),
        (replace(image(picture()), data=np.zeros(100, np.uint8)), "has 100 bytes in rows of 24"),
        (
            compressed(b"RVL of depth", "16UC1; compressedDepth"),
            "format '16UC1; compressedDepth' is neither jpeg nor png",
        ),
        (compressed(b"\x89PNG", "16UC1; png compressed "), "'16UC1; png compressed ' holds numbers, as of depth"),
        (compressed(b"\xff\xd8\xff cut off", "jpeg"), "image 0 on /front/image_raw cannot be read"),
    ],
)
def test_other_images_are_refused_by_their_name(tmp_path: Path, message: Any, said: str) -> None:
    with pytest.raises(SourceError) as raised:
        one(tmp_path, message)
    assert said in str(raised.value)


def test_rectified_images_have_the_projection_without_distortion(tmp_path: Path) -> None:
    (frame,) = frames_of(bag(tmp_path, [(INFO, info(), 0), ("/front/image_rect_color", image(picture()), 1)]))
    assert frame.camera == Camera(WIDTH, HEIGHT, 9.0, 9.5, 3.1, 2.2)


def test_a_region_of_interest_and_binning_are_applied(tmp_path: Path) -> None:
    told = info(size=(40, 30), roi=(4, 8, 2 * HEIGHT, 2 * WIDTH), bins=2, k=[20.0, 0, 19.5, 0, 20.0, 14.5, 0, 0, 1])
    (frame,) = frames_of(bag(tmp_path, [(INFO, told, 0), (RAW, image(picture()), 1)]))
    camera = frame.camera
    assert (camera.width, camera.height, camera.fx, camera.fy) == (WIDTH, HEIGHT, 10.0, 10.0)
    # Two rows and columns of pixels of the window become one: its middle is half a pixel on.
    assert (camera.cx, camera.cy) == pytest.approx(((19.5 - 4 + 0.5) / 2 - 0.5, (14.5 - 8 + 0.5) / 2 - 0.5))


def test_a_zoom_is_followed(tmp_path: Path) -> None:
    nearer = [20.0, *K[1:]]
    sent: list[Sent] = [
        (INFO, info(), 1), (RAW, image(picture()), 2), (INFO, info(k=nearer), 3), (RAW, image(picture()), 4)
    ]  # fmt: skip
    assert [frame.camera.fx for frame in frames_of(bag(tmp_path, sent))] == [10.0, 20.0]


def test_a_camera_info_that_is_recorded_after_its_image_is_the_images(tmp_path: Path) -> None:
    nearer = replace(info(k=[20.0, *K[1:]]), header=header(2, BEGAN_NS + 5))
    sent: list[Sent] = [
        (RAW, image(picture()), 1), (INFO, info(), 2),
        (RAW, image(picture(), at_ns=BEGAN_NS + 5), 3), (INFO, nearer, 4),
        (RAW, image(picture(), at_ns=BEGAN_NS + 9), 5),
    ]  # fmt: skip
    assert [frame.camera.fx for frame in frames_of(bag(tmp_path, sent))] == [10.0, 20.0, 20.0]


def test_lenses_that_are_not_supported_are_refused_by_name(tmp_path: Path) -> None:
    for i, (told, said) in enumerate(
        [
            (info(model="equidistant", d=[0.1, 0.0, 0.0, 0.0]), "equidistant is a fisheye lens"),
            (
                info(model="rational_polynomial", d=[*D, 0.0, 0.2, 0.0]),
                "k5 of OpenCV's rational model are not supported",
            ),
            (info(k=[K[0], 0.5, *K[2:]]), "has a skew of 0.5 px between the axes"),
            (info(bins=100), "its CameraInfo cannot be used"),
            (info(model="thin_prism", d=D), "distortion model 'thin_prism' is not known"),
            (info(size=(16, 12)), "are 8x6, but /front/camera_info is of 16x12; give --camera.camera-file"),
        ]
    ):
        root = tmp_path / f"{i}"
        root.mkdir()
        path = bag(root, [(INFO, told, 0), (RAW, image(picture()), 1)])
        with pytest.raises(SourceError) as raised:
            frames_of(path)
        assert said in str(raised.value)
        (root / "camera.json").write_text('{"width": 8, "height": 6, "fx": 7, "fy": 7, "cx": 4, "cy": 3}')
        assert frames_of(path, camera_file=root / "camera.json")[0].camera.fx == 7.0


def test_a_rational_lens_of_five_coefficients_is_used(tmp_path: Path) -> None:
    told = info(model="rational_polynomial", d=[*D, 0.0, 0.0, 0.0])
    (frame,) = frames_of(bag(tmp_path, [(INFO, told, 0), (RAW, image(picture()), 1)]))
    assert frame.camera.distortion == tuple(D)


@pytest.mark.parametrize("told", [[], [(INFO, info(k=[0.0] * 9), 0)], [("/other/camera_info", info(), 0)]])
def test_a_bag_that_tells_no_camera_has_an_assumed_one(tmp_path: Path, told: list[Sent]) -> None:
    (frame,) = frames_of(bag(tmp_path, [*told, (RAW, image(picture()), 1)]), fov_deg=90.0)
    assert (frame.origin, frame.camera.fx) == (CameraOrigin.ASSUMED, pytest.approx(4.0))


def test_an_image_without_a_stamp_was_taken_when_it_was_recorded(tmp_path: Path) -> None:
    (frame,) = frames_of(bag(tmp_path, [(RAW, image(picture(), at_ns=0), BEGAN_NS)]))
    assert frame.at_ns == BEGAN_NS


@pytest.mark.parametrize(
    ("stamps", "expected"),
    [
        ([0, 100, 200], [0, 100, 200]),
        ([BEGAN_NS, 0, BEGAN_NS + 200], [BEGAN_NS, BEGAN_NS + 100, BEGAN_NS + 200]),
        ([-(10**9), 0, BEGAN_NS + 200], [BEGAN_NS, BEGAN_NS + 100, BEGAN_NS + 200]),
    ],
    ids=["a simulation that begins at 0", "one is missing", "before the epoch"],
)
def test_images_without_a_stamp_are_among_those_that_have_one(
    tmp_path: Path, stamps: list[int], expected: list[int]
) -> None:
    logged_ns = BEGAN_NS + 10**15
    path = bag(tmp_path, [(RAW, image(picture(), at_ns=at), logged_ns + i * 100) for i, at in enumerate(stamps)])
    assert [frame.at_ns for frame in frames_of(path)] == expected
    assert [frame.at_ns for frame in frames_of(path, first=1)] == expected[1:]


def test_an_image_before_the_epoch_was_taken_when_it_was_recorded(tmp_path: Path) -> None:
    assert one(tmp_path, image(picture(), at_ns=-5)).at_ns == BEGAN_NS


@pytest.mark.parametrize("kind", ["db3", "mcap"])
@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE])
def test_of_a_compressed_bag_the_folder_is_read_and_asked_for(tmp_path: Path, kind: str, mode: CompressionMode) -> None:
    sent: list[Sent] = [(INFO, info(), BEGAN_NS), (RAW, image(picture()), BEGAN_NS)]
    with suppress(StopIteration):  # the file's name has another ending
        bag(tmp_path, sent, kind, mode)
    (frame,) = frames_of(tmp_path / "a")
    np.testing.assert_array_equal(frame.image, picture())
    (alone,) = (path for path in (tmp_path / "a").iterdir() if path.suffix != ".yaml")
    with pytest.raises(SourceError, match=r"compressed .*; give the folder of the bag"):
        frames_of(alone)


def test_of_several_topics_one_has_to_be_chosen(tmp_path: Path) -> None:
    left, right = picture(1), picture(2)
    path = bag(tmp_path, [("/left/image_raw", image(left), 1), ("/right/image_raw", image(right), 2)])
    with pytest.raises(SourceError) as raised:
        frames_of(path)
    assert str(raised.value) == (
        f"{path}: images on /left/image_raw, /right/image_raw; choose a topic, for instance bag:{path}#/left/image_raw"
    )
    (frame,) = frames_of(f"{path}#/right/image_raw")
    np.testing.assert_array_equal(frame.image, right)
    with pytest.raises(SourceError, match="no images on /up in this bag, which has them on /left/image_raw"):
        frames_of(f"{path}#/up")


def test_what_is_no_bag_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "text.bag").write_text("no bag")
    (tmp_path / "text.db3").write_text("no bag")
    (tmp_path / "text.mcap").write_text("no bag")
    (tmp_path / "empty").mkdir()
    for name, said in (
        ("nothing.bag", "no such bag"),
        ("text.bag", "cannot be read as a bag"),
        ("text.db3", "cannot be read as a bag"),
        ("text.mcap", "cannot be read as a bag"),
        ("empty", "has no metadata.yaml, as folders of ROS 2's bags have"),
    ):
        with pytest.raises(SourceError) as raised:
            frames_of(tmp_path / name)
        assert str(raised.value).startswith(f"{tmp_path / name}: {said}")
        assert "\n" not in str(raised.value)
    (tmp_path / "a.mp4").touch()
    with pytest.raises(SourceError, match="expected a bag of ROS 1"):
        frames_of(tmp_path / "a.mp4")
    path = bag(tmp_path, [(INFO, info(), 1)])
    with pytest.raises(
        SourceError, match=r"no images in this bag, which holds /front/camera_info \(sensor_msgs/msg/Cam"
    ):
        frames_of(path)


def test_a_recording_of_ones_own_is_no_bag(tmp_path: Path) -> None:
    RecordingWriter(tmp_path / "a.mcap").close()
    with pytest.raises(SourceError, match="recordings of fieldpose itself are read as mcap:FILE"):
        frames_of(tmp_path / "a.mcap")


def test_a_bag_that_ends_early_is_refused_in_one_line(tmp_path: Path) -> None:
    path = bag(tmp_path, [(RAW, image(picture(i)), i + 1) for i in range(40)])
    path.write_bytes(path.read_bytes()[:-300])
    with pytest.raises(SourceError, match="cannot be read as a bag"):
        frames_of(path)


def test_mcap_says_of_a_bag_of_ros_what_it_holds(tmp_path: Path) -> None:
    path = bag(tmp_path, [(RAW, image(picture()), 1)])
    with pytest.raises(SourceError) as raised:
        open_source(CameraConfig(f"mcap:{path}"))
    assert str(raised.value) == (
        f"{path}: is a recording of ros2, with {RAW} (sensor_msgs/msg/Image); --source bag:{path} reads the images of"
        " ROS' bags"
    )


def test_mcap_says_of_an_export_that_it_is_none_of_ones_own(tmp_path: Path) -> None:
    with ForeignWriter(tmp_path / "a.mcap") as writer:
        writer.channel("/camera/image", "json", ("foxglove.CompressedImage", "jsonschema", b"{}"))
        writer.write("/camera/image", b"{}", 1, 1, 0)
    with pytest.raises(SourceError) as raised:
        open_source(CameraConfig(f"mcap:{tmp_path / 'a.mcap'}"))
    assert str(raised.value) == (
        f"{tmp_path / 'a.mcap'}: is a recording of another program, with /camera/image (foxglove.CompressedImage); give"
        " the recording of fieldpose itself"
    )


def test_without_rosbags_it_says_what_to_install(tmp_path: Path) -> None:
    path = bag(tmp_path, [(RAW, image(picture()), 1)])
    program = f"""
import sys
sys.modules["rosbags"] = None
from fieldpose.deploy.cli import main
sys.exit(main(["calibrate", "bag:{path}", "--out", "{tmp_path}/camera.json"]))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr == f"fieldpose: {path}: rosbags, which reads bags, is missing; pip install 'fieldpose[ros]'\n"
