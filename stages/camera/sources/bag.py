"""The images of a ROS bag, of ROS 1 or 2, with the camera that its CameraInfo tells and their own stamps."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fieldpose.bus.messages import CameraOrigin, Encoding
from fieldpose.errors import FieldposeError, SourceError
from fieldpose.stages.camera.calibration import Calibration, Calibrator
from fieldpose.stages.camera.config import CameraConfig
from fieldpose.stages.camera.core import CapturedFrame, Source
from fieldpose.stages.camera.ros import (
    COMPRESSED,
    IMAGE,
    INFO,
    camera_of_info,
    image_of,
    info_topic,
    is_rectified,
    size_of,
    stamp_ns,
)
from fieldpose.stages.geometry import Camera
from fieldpose.stages.images import decoded, shrunk_with_camera

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection

_KINDS = (".bag", ".mcap", ".db3")
_STAMPED_WITHIN = 10
_ZSTD = b"\x28\xb5\x2f\xfd"


def open_bag(rest: str, config: CameraConfig, calibrator: Calibrator) -> Source:
    """bag:FILE or bag:FOLDER, with #TOPIC after it where there are images on several topics.

    config.camera_file comes before the bag's CameraInfo, and where neither tells a camera the calibrator finds one.
    Raises SourceError for what is no bag, for a topic that is not there or not named, and for images and cameras that
    are not supported.
    """
    bag = _named(rest, config, calibrator)
    first = next(bag.images(0), None)
    if first is None:
        raise SourceError(f"{bag.path}: no images on {bag.topic}")
    return Source(f"bag {bag.path}, {bag.topic}, {first.calibration.told}", "own", bag.frames, bag.length)


class _Image(NamedTuple):
    """Pixels or a file as CapturedFrame has them, with the camera of that size, taken at at_ns."""

    pixels: np.ndarray
    encoding: Encoding
    at_ns: int
    calibration: Calibration


class _Message(NamedTuple):
    """An image of ROS, taken at at_ns, with the camera of the CameraInfo stamped told_ns, None for the bag's first."""

    image: Any
    at_ns: int
    number: int
    told: Camera | None
    told_ns: int | None

    def is_of(self, told_ns: int) -> bool:
        """Whether a CameraInfo of that stamp is its own, where none was so far."""
        return stamp_ns(self.image) == told_ns != self.told_ns


@dataclass(frozen=True)
class _Bag:
    path: Path
    topic: str
    length: int
    config: CameraConfig
    calibrator: Calibrator

    def frames(self, first: int) -> Iterator[CapturedFrame]:
        for number, image in enumerate(self.images(first), first):
            pixels, encoding, camera = image.pixels, image.encoding, image.calibration.camera
            size = self.config.size
            if size is not None and max(camera.width, camera.height) > size:
                whole = decoded(encoding, pixels, camera.width, camera.height)
                if whole is None:
                    raise self._unreadable(number)
                (pixels, camera), encoding = shrunk_with_camera(whole, camera, size), "rgb8"
            name, origin = f"{self.path.name}#{number}", image.calibration.origin
            yield CapturedFrame(number, pixels, encoding, camera, name, image.at_ns, origin=origin)

    def images(self, first: int) -> Iterator[_Image]:
        """From that one on, each with the CameraInfo of its stamp that is next to it, else the newest or the first one.

        Recorders write an image and its CameraInfo in either order.
        """
        told, told_ns, ahead_ns = self._first_camera(), None, self._stamps_ahead_ns()
        with _opened(self.path) as reader:
            number, waiting = 0, None
            for connection, logged_ns, data in self._messages(reader, self._wants):
                if connection.topic != self.topic:
                    info = reader.deserialize(data, INFO)
                    told, told_ns = self._camera(info), stamp_ns(info)
                    if waiting is not None and waiting.is_of(told_ns):
                        waiting = waiting._replace(told=told, told_ns=told_ns)
                    continue
                if waiting is not None:
                    yield self._image(waiting)
                waiting = None
                if number >= first:
                    image = reader.deserialize(data, connection.msgtype)
                    waiting = _Message(image, stamp_ns(image) or logged_ns + ahead_ns, number, told, told_ns)
                number += 1
            if waiting is not None:
                yield self._image(waiting)

    def _stamps_ahead_ns(self) -> int:
        """How far stamps are ahead of the times of recording, which is years where they are of a simulation's clock.

        0 where none of the first images has a stamp. It places images without one among those that have.
        """
        with _opened(self.path) as reader:
            images = self._messages(reader, lambda connection: connection.topic == self.topic)
            for connection, logged_ns, data in islice(images, _STAMPED_WITHIN):
                stamped_ns = stamp_ns(reader.deserialize(data, connection.msgtype))
                if stamped_ns:
                    return stamped_ns - logged_ns
        return 0

    def _image(self, message: _Message) -> _Image:
        number, told, at_ns = message.number, message.told, message.at_ns
        try:
            pixels, encoding = image_of(message.image)
        except SourceError as error:
            raise SourceError(f"{self.path}: image {number} on {self.topic}: {error}") from error
        size = size_of(pixels, encoding)
        if size is None:
            raise self._unreadable(number)
        if told is None:
            return _Image(pixels, encoding, at_ns, self.calibrator.of(*size))
        if (told.width, told.height) != size:
            raise SourceError(
                f"{self.path}: images on {self.topic} are {size[0]}x{size[1]}, but {info_topic(self.topic)} is of"
                f" {told.width}x{told.height}; give --camera.camera-file"
            )
        calibration = Calibration(told, CameraOrigin.CALIBRATED, f"camera of {info_topic(self.topic)}")
        return _Image(pixels, encoding, at_ns, calibration)

    def _unreadable(self, number: int) -> SourceError:
        return SourceError(f"{self.path}: image {number} on {self.topic} cannot be read")

    def _first_camera(self) -> Camera | None:
        with _opened(self.path) as reader:
            for _, _, data in self._messages(reader, self._tells):
                return self._camera(reader.deserialize(data, INFO))
        return None

    def _messages(
        self, reader: AnyReader, wanted: Callable[[Connection], bool]
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """None where there are no such connections; of a reader that would be all messages."""
        connections = [connection for connection in reader.connections if wanted(connection)]
        for connection, logged_ns, data in reader.messages(connections) if connections else ():
            if data[:4] == _ZSTD:
                raise SourceError(
                    f"{self.path}: its messages are compressed one by one, as the metadata.yaml beside it says; give"
                    " the folder of the bag"
                )
            yield connection, logged_ns, data

    def _wants(self, connection: Connection) -> bool:
        return connection.topic == self.topic or self._tells(connection)

    def _tells(self, connection: Connection) -> bool:
        """Whether the camera is told there, and is not given in the settings."""
        told = connection.msgtype == INFO and connection.topic == info_topic(self.topic)
        return told and self.config.camera_file is None

    def _camera(self, info: Any) -> Camera | None:
        try:
            return camera_of_info(info, is_rectified(self.topic))
        except SourceError as error:
            topic = info_topic(self.topic)
            raise SourceError(f"{self.path}: {topic}: {error}; or give --camera.camera-file") from error


def _named(rest: str, config: CameraConfig, calibrator: Calibrator) -> _Bag:
    name, mark, topic = rest.partition("#")
    path = Path(rest) if Path(rest).exists() else Path(name)
    if not path.exists():
        raise SourceError(f"{path}: no such bag")
    if path.suffix == ".zstd":
        raise SourceError(f"{path}: a part of a bag, compressed as a whole; give the folder of the bag")
    if path.is_dir() and not (path / "metadata.yaml").exists():
        raise SourceError(f"{path}: has no metadata.yaml, as folders of ROS 2's bags have; of ROS 1 give the .bag file")
    if not path.is_dir() and path.suffix not in _KINDS:
        raise SourceError(f"{path}: expected a bag of ROS 1 (.bag) or of ROS 2 (.mcap, .db3 or its folder)")
    with _opened(path) as reader:
        counts: dict[str, int] = {}
        kinds = {c.topic: c.msgtype for c in reader.connections}
        for connection in reader.connections:
            counts[connection.topic] = counts.get(connection.topic, 0) + connection.msgcount
    images = sorted(topic for topic, kind in kinds.items() if kind in (IMAGE, COMPRESSED))
    if not images:
        held = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(kinds.items())) or "nothing"
        raise SourceError(f"{path}: no images in this bag, which holds {held}")
    wanted = topic if mark and path == Path(name) else ""
    if wanted and wanted not in images:
        raise SourceError(f"{path}: no images on {wanted} in this bag, which has them on {', '.join(images)}")
    if not wanted and len(images) > 1:
        raise SourceError(f"{path}: images on {', '.join(images)}; choose a topic, for instance bag:{path}#{images[0]}")
    chosen = wanted or images[0]
    return _Bag(path, chosen, counts[chosen], config, calibrator)


@contextmanager
def _opened(path: Path) -> Iterator[AnyReader]:
    """A reader of the bag. SourceError where it cannot be opened or read, or rosbags is not installed."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise SourceError(f"{path}: rosbags, which reads bags, is missing; pip install 'fieldpose[ros]'") from error
    try:
        # Bags of ROS 2 before Iron hold no definitions; a camera's messages are the same in all versions of ROS 2.
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            yield reader
    except FieldposeError:
        raise
    except Exception as error:  # rosbags does not tell what damaged bytes raise
        detail = " ".join(str(error).split()) or type(error).__name__
        hint = "; recordings of fieldpose itself are read as mcap:FILE" if "Profile is not" in detail else ""
        raise SourceError(f"{path}: cannot be read as a bag ({detail}){hint}") from error
