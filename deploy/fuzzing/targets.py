"""Everything that reads bytes from outside: its right inputs, how it is called, and what it may raise."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from fieldpose.bus.codec import decode, decode_header, encode
from fieldpose.bus.memory import MemoryBus
from fieldpose.bus.messages import CameraInfo, State
from fieldpose.bus.ports import Inbox
from fieldpose.bus.presence import Presence
from fieldpose.bus.requests import KINDS, ControlValues, Show, decode_answer, decode_request
from fieldpose.bus.topics import ALL, CAMERA_INFO, FRAME, STATE, Address, Topic
from fieldpose.deploy.fuzzing import seeds
from fieldpose.deploy.fuzzing.campaign import Input, Target
from fieldpose.deploy.fuzzing.samples import sample
from fieldpose.errors import (
    CodecError,
    ConfigError,
    DatasetError,
    FieldFileError,
    GeometryError,
    RecordingError,
    SourceError,
)

_BYTES, _RECORDING, _VIDEO = "bytes", "a.mcap", "a.mp4"
_DATASETS: dict[str, Callable[[Path], list[Input]]] = {
    "transforms": lambda _: seeds.transforms(),
    "blender": lambda _: seeds.blender(),
    "llff": lambda _: seeds.llff(),
    "colmap": lambda _: seeds.colmap(),
    "tum": lambda _: seeds.tum(),
    "7scenes": lambda _: seeds.seven_scenes(),
    "bop": lambda _: seeds.bop(),
    "record3d": lambda _: seeds.record3d(),
    "polycam": lambda _: seeds.polycam(),
}
_PHOTO_ERRORS = (DatasetError, SourceError)


def targets() -> dict[str, Target]:
    """All of them, by name."""
    found = [*_wire(), *_recordings(), *_files(), *_datasets(), *_ros()]
    return {target.name: target for target in found}


def _of_bytes(read: Callable[[bytes], object]) -> Callable[[Path], object]:
    return lambda folder: read((folder / _BYTES).read_bytes())


def _payload(topic: Topic[Any]) -> bytes:
    return encode(sample(topic.message_type))


def _wire() -> list[Target]:
    def one_of(topic: Topic[Any]) -> Target:
        read = _of_bytes(lambda data: decode(data, topic.message_type, topic.max_bytes))
        return Target(f"wire/{topic.name}", read, lambda _: [{_BYTES: _payload(topic)}], (CodecError,))

    requests = [encode(sample(kind)) for kind in KINDS.values()]
    answer = encode(sample(ControlValues))
    word = b'{"held":["fieldpose/live/object/camera0/pnp"],"changes":1,"number":3,"to":""}'
    plain: tuple[tuple[str, Callable[[bytes], object], list[bytes]], ...] = (
        ("wire/header", decode_header, [_payload(topic) for topic in (FRAME, STATE)]),
        ("wire/request", decode_request, requests),
        ("wire/answer", lambda payload: decode_answer(payload, Show()), [answer]),
        ("wire/presence", _hear, [word, word.replace(b'"to":""', b'"to":"me"')]),
        ("wire/inbox", _receive, [_payload(topic) for topic in ALL]),
        ("wire/image", _see, [seeds.picture("JPEG"), seeds.picture("PNG"), seeds.picture("PNG", "RGBA")]),
    )

    def given(name: str, read: Callable[[bytes], object], payloads: list[bytes]) -> Target:
        return Target(name, _of_bytes(read), lambda _: [{_BYTES: payload} for payload in payloads], (CodecError,))

    return [*map(one_of, ALL), *(given(*each) for each in plain)]


def _hear(data: bytes) -> None:
    presence = Presence("me", lambda word: None, lambda: ["other"])
    try:
        presence.heard("other", data)
        presence.live("fieldpose/live/*/*/*")
    finally:
        presence.close()


def _receive(data: bytes) -> None:
    """As a client of the public API does; what is no message is counted."""
    bus = MemoryBus()
    inbox = Inbox(bus, Address(), (STATE, CAMERA_INFO))
    for topic in (STATE, CAMERA_INFO):
        bus.put(Address().key(topic), data, topic)
    for received in inbox.drain():
        assert isinstance(received.message, State | CameraInfo)
    inbox.close()


def _see(data: bytes) -> None:
    """A frame's file as the stages see it."""
    from fieldpose.stages.images import decoded, encoded_size

    pixels = np.frombuffer(data, np.uint8)
    encoded_size(pixels)
    for encoding in ("jpeg", "png"):
        decoded(encoding, pixels, seeds.WIDTH, seeds.HEIGHT)


def _recordings() -> list[Target]:
    def made(folder: Path) -> list[Input]:
        from fieldpose.bus.recording import RecordingWriter

        writer = RecordingWriter(folder / _RECORDING, {"a": {"b": "c"}})
        for topic in (FRAME, STATE, CAMERA_INFO):
            writer.write_payload(Address().key(topic, "a"), topic, _payload(topic), 1000)
        writer.close()
        return [{_RECORDING: (folder / _RECORDING).read_bytes()}]

    def read(folder: Path) -> None:
        from fieldpose.bus.reading import info, of_another_program, read_recording

        of_another_program(folder / _RECORDING)
        info(folder / _RECORDING)
        for _ in read_recording(folder / _RECORDING):
            pass

    def save(folder: Path) -> None:
        from fieldpose.bus.recovery import recover

        recover(folder / _RECORDING, folder / "out.mcap")

    return [
        Target("recording/read", read, made, (RecordingError,)),
        Target("recording/recover", save, made, (RecordingError,)),
    ]


def _files() -> list[Target]:
    def field(folder: Path) -> None:
        from fieldpose.stages.nerf.field import load_field

        found = load_field(folder / "f.safetensors")
        for view in found.metadata.cameras:
            assert view.camera.width > 0
            assert view.pose.shape == (4, 4)
        assert found.metadata.frame.object_from_dataset.scale > 0

    def camera(folder: Path) -> None:
        from fieldpose.stages.camera.camera_files import read_camera_file

        for path in folder.iterdir():
            read_camera_file(path)

    def configuration(folder: Path) -> None:
        from fieldpose.deploy.rig import read_rig

        for path in folder.iterdir():
            read_rig(path)

    def guess(folder: Path) -> None:
        from fieldpose.stages.tracking.beginning import read_guess_file

        read_guess_file(folder / "a.json")

    return [
        Target("field", field, seeds.field_files, (FieldFileError,)),
        Target("camera", camera, lambda _: seeds.cameras(), (SourceError,)),
        Target("settings", configuration, lambda _: seeds.settings(), (ConfigError,)),
        Target("guess", guess, lambda _: seeds.guesses(), (ConfigError,)),
        Target("photo", _photo, lambda _: seeds.images(), _PHOTO_ERRORS),
        Target("depth", _depth, lambda _: _depths(), _PHOTO_ERRORS),
        Target("video", _video, _videos, (SourceError,)),
    ]


def _photo(folder: Path) -> None:
    """As `estimate`, sources of folders and masks read it."""
    from fieldpose.stages.camera.calibration import Calibrator
    from fieldpose.stages.camera.config import CameraConfig
    from fieldpose.stages.camera.sources.folder import open_folder
    from fieldpose.stages.nerf.datasets import images

    path, config = folder / "a.png", CameraConfig("")
    for frame in open_folder(str(folder), config, Calibrator(config)).frames(0):
        assert frame.camera.width > 0
    images.upright_size(path)
    images.upright_rgba(path)
    images.load_pixels(path, 8, 6, alpha=True)
    images.load_mask(path, 8, 6)


def _depths() -> list[Input]:
    import io

    file = io.BytesIO()
    np.save(file, np.ones((6, 8), np.float32))
    return [{"a.npy": file.getvalue()}, {"a.png": seeds.picture(mode="I;16")}]


def _depth(folder: Path) -> None:
    from fieldpose.stages.nerf.datasets.images import load_depth

    for path in folder.iterdir():
        load_depth(path, 8, 6, 0.001)


def _videos(folder: Path) -> list[Input]:
    import cv2

    folder.mkdir(parents=True)
    rng = np.random.default_rng(0)
    writer = cv2.VideoWriter(str(folder / _VIDEO), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (64, 48))
    for _ in range(4):
        writer.write(rng.integers(0, 256, (48, 64, 3)).astype(np.uint8))
    writer.release()
    return [{_VIDEO: (folder / _VIDEO).read_bytes()}]


def _video(folder: Path) -> None:
    from fieldpose.stages.camera.calibration import Calibrator
    from fieldpose.stages.camera.config import CameraConfig
    from fieldpose.stages.camera.sources.video import open_video

    config = CameraConfig("")
    for index, _ in enumerate(open_video(str(folder / _VIDEO), config, Calibrator(config)).frames(0)):
        if index > 20:
            break


def _datasets() -> list[Target]:
    def read(place: str, folder: Path) -> None:
        from fieldpose.stages.nerf.datasets import load_dataset

        # TUM's cameras are told by the folder's name, and BOP's objects by the path.
        load_dataset(folder / place, "all")

    def one_of(kind: str) -> Target:
        make, place = _DATASETS[kind], "obj_000005" if kind == "bop" else "."
        return Target(f"dataset/{kind}", partial(read, place), make, (DatasetError,))

    return [one_of(kind) for kind in _DATASETS]


def _ros() -> list[Target]:
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        return []
    from fieldpose.deploy.bridges.ros_messages import POSE, Frames, RosMessages
    from fieldpose.stages.camera.ros import COMPRESSED, IMAGE, INFO, camera_of_info, image_of, stamp_ns

    store = get_typestore(Stores.ROS2_JAZZY)
    known, bridge = store.types, RosMessages(Frames())

    def header() -> Any:
        stamp = known["builtin_interfaces/msg/Time"](1, 2)
        return known["std_msgs/msg/Header"](stamp=stamp, frame_id="object")

    def messages() -> dict[str, Any]:
        rows, file = np.arange(144, dtype=np.uint8), np.frombuffer(seeds.picture("PNG", "L"), np.uint8)
        region = known["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        point = known["geometry_msgs/msg/Point"](1.0, 2.0, 3.0)
        turn = known["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        pose = known["geometry_msgs/msg/Pose"](point, turn)
        both = known["geometry_msgs/msg/PoseWithCovariance"](pose, np.zeros(36))
        k, p = np.diag([9.0, 9.0, 1.0]).ravel(), np.diag([9.0, 9.0, 1.0, 0.0])[:3].ravel()
        return {
            IMAGE: known[IMAGE](header(), 6, 8, "rgb8", 0, 24, rows),
            COMPRESSED: known[COMPRESSED](header(), "bayer_rggb8; png compressed ", file),
            INFO: known[INFO](header(), 6, 8, "plumb_bob", np.zeros(5), k, np.eye(3).ravel(), p, 0, 0, region),
            POSE: known[POSE](header(), both),
        }

    uses: dict[str, Callable[[Any], object]] = {
        IMAGE: image_of, COMPRESSED: image_of, INFO: lambda message: camera_of_info(message, False), POSE: bridge.guess,
    }  # fmt: skip

    def read(kind: str, data: bytes) -> None:
        message = bridge.decoded(data, kind)
        stamp_ns(message)
        uses[kind](message)

    def one_of(kind: str, message: Any) -> Target:
        given = [{_BYTES: bytes(store.serialize_cdr(message, kind))}]
        errors = (ConfigError, SourceError, GeometryError)
        return Target(f"ros/{kind.rpartition('/')[2]}", _of_bytes(partial(read, kind)), lambda _: given, errors)

    return [*(one_of(kind, message) for kind, message in messages().items()), *_bags(store, messages())]


def _bags(store: Any, messages: dict[str, Any]) -> list[Target]:
    from fieldpose.stages.camera.ros import IMAGE, INFO

    def made(folder: Path) -> list[Input]:
        from rosbags.rosbag2 import StoragePlugin, Writer

        found: list[Input] = []
        folder.mkdir(parents=True)
        for plugin in (StoragePlugin.MCAP, StoragePlugin.SQLITE3):
            with Writer(folder / plugin.name, version=9, storage_plugin=plugin) as out:
                for topic, kind in (("/camera/camera_info", INFO), ("/camera/image_raw", IMAGE)):
                    connection = out.add_connection(topic, kind, typestore=store)
                    out.write(connection, 1000, store.serialize_cdr(messages[kind], kind))
            found += [{path.name: path.read_bytes() for path in sorted((folder / plugin.name).iterdir())}]
        return found

    def read(folder: Path) -> None:
        from fieldpose.stages.camera.calibration import Calibrator
        from fieldpose.stages.camera.config import CameraConfig
        from fieldpose.stages.camera.sources.bag import open_bag

        config = CameraConfig("")
        for _ in open_bag(str(folder), config, Calibrator(config)).frames(0):
            pass

    return [Target("bag", read, made, (SourceError,))]
