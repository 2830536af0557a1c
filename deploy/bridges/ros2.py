"""A running pipeline as a node of ROS 2: its states as poses, transforms and diagnostics; poses and images from ROS."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from fieldpose.bus.logs import Throttle, stage_logger
from fieldpose.bus.messages import CameraInfo, CameraOrigin, Prior, State
from fieldpose.bus.node import first_header
from fieldpose.bus.ports import Inbox, Outbox
from fieldpose.bus.protocol import SETTLE_S, Bus, Sink
from fieldpose.bus.ros2 import RosNames, RosNode, RosTopic
from fieldpose.bus.topics import CAMERA_INFO, PRIOR, STATE, Address
from fieldpose.deploy.bridges.ros_messages import DIAGNOSTICS, ODOMETRY, POSE, TF, RosMessages, is_published
from fieldpose.errors import ConfigError, FieldposeError, SourceError
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
from fieldpose.stages.camera.wire import frame_messages
from fieldpose.stages.geometry import Camera

_POLL_S = 0.05
_SAY_NS = 10**9
_STALE_NS = 2 * 10**9
_LATEST_NS = 60 * 10**9
_PRIORS, _INFOS = 16, 4


@dataclass(frozen=True)
class RosTopics:
    """Topics of ROS, each left out where it is empty; a name without / at its start lies in the node's namespace."""

    pose: str = "fieldpose/pose"
    """Poses that tracking is sure of, PoseWithCovarianceStamped."""
    odometry: str = "fieldpose/odometry"
    """The same as Odometry; velocities are not known."""
    tf: str = "/tf"
    """The same as transforms; leave it out (--topics.tf "") where something else publishes the frame's transform."""
    diagnostics: str = "/diagnostics"
    """How tracking is, once a second and where that changes, DiagnosticArray."""
    prior: str = ""
    """PoseWithCovarianceStamped to take as a guess of the next frame's pose; off by default."""
    image: str = ""
    """Image, or CompressedImage by a name that ends in /compressed, to send as frames of `--source bus`."""
    camera_info: str = ""
    """The images' CameraInfo; by default camera_info beside the images."""


class RosBridge:
    """Carries messages between a pipeline and a node of ROS. Raises FieldposeError for settings that cannot be used."""

    def __init__(
        self, bus: Bus, address: Address, node: RosNode, names: RosNames, topics: RosTopics, messages: RosMessages
    ) -> None:
        if "*" in (address.object, address.camera, address.site):
            raise ConfigError(f"pipeline {address.pair}: expected one, without *; start a bridge for each")
        self._bus, self._address, self._node, self._messages = bus, address, node, messages
        self._throttle = Throttle(stage_logger("bridge"))
        self._numbers = NextFrame()
        self._camera: Camera | None = None
        self._images = 0
        self._frames, self._guesses = Outbox(bus, address, "camera"), Outbox(bus, address, "bridge")
        self.published: list[RosTopic] = []
        self.taken: list[RosTopic] = []
        self._senders = {
            kind: self._publisher(names.resolved(name), kind)
            for name, kind in ((topics.pose, POSE), (topics.odometry, ODOMETRY), (topics.tf, TF))
            if name
        }
        self._say = self._publisher(names.resolved(topics.diagnostics), DIAGNOSTICS) if topics.diagnostics else None
        if topics.prior:
            self._subscribe(names.resolved(topics.prior), POSE, self._on_prior, _PRIORS)
        if topics.image:
            image = names.resolved(topics.image)
            self._rectified = is_rectified(image)
            self._subscribe(names.resolved(topics.camera_info or info_topic(image)), INFO, self._on_info, _INFOS)
            kind = COMPRESSED if image.endswith("/compressed") else IMAGE
            self._subscribe(image, kind, self._on_image, 1)
            self._frames.announce()  # until the bus is closed

    def run(self, stop: threading.Event) -> None:
        """Carry messages until `stop`."""
        inbox = Inbox(self._bus, self._address, (STATE, CAMERA_INFO))
        self._bus.settle(SETTLE_S)
        newest: State | None = None
        latency_ms: float | None = None
        heard_ns = said_ns = 0
        try:
            while not stop.is_set():
                received = inbox.get(_POLL_S)
                now_ns = time.time_ns()
                before = newest
                if received is not None and isinstance(received.message, CameraInfo):
                    self._numbers.seen(received.message.header.frame_id)
                elif received is not None and isinstance(received.message, State):
                    newest, heard_ns = received.message, now_ns
                    latency_ms = _latency_ms(newest, received.received_ns)
                    self._publish(newest)
                elif now_ns - heard_ns > _STALE_NS:
                    newest = None
                if _differs(before, newest) or now_ns - said_ns >= _SAY_NS:
                    said_ns = now_ns
                    self._diagnose(newest, now_ns, latency_ms)
        finally:
            inbox.close()

    def _publish(self, state: State) -> None:
        if not is_published(state):
            return
        makers = {POSE: self._messages.pose, ODOMETRY: self._messages.odometry, TF: self._messages.tf}
        for kind, send in self._senders.items():
            send(makers[kind](state))

    def _diagnose(self, state: State | None, now_ns: int, latency_ms: float | None) -> None:
        if self._say is not None:
            self._say(self._messages.diagnostics(self._address.pair, now_ns, state, latency_ms))

    def _on_prior(self, message: Any) -> None:
        pose = self._messages.guess(message)
        number = self._numbers.next
        if number is None:
            self._throttle.warning("a prior before any frame is left out")
            return
        header = first_header(number, stamp_ns(message) or time.time_ns())
        self._guesses.publish(PRIOR, Prior(header=header, cam_from_object=pose))

    def _on_info(self, message: Any) -> None:
        self._camera = None  # of images that follow one that cannot be used, no older camera is true
        self._camera = camera_of_info(message, self._rectified)

    def _on_image(self, message: Any) -> None:
        camera = self._camera
        if camera is None:
            self._throttle.warning("images without a CameraInfo that can be used are left out")
            return
        pixels, encoding = image_of(message)
        size, told = size_of(pixels, encoding), (camera.width, camera.height)
        if size != told:
            read = "cannot be read" if size is None else "is {}x{}".format(*size)
            raise SourceError(f"an image {read}, its CameraInfo is of {told[0]}x{told[1]}")
        header = first_header(self._images, stamp_ns(message) or time.time_ns())
        for topic, sent in frame_messages(header, pixels, encoding, camera, CameraOrigin.CALIBRATED):
            self._frames.publish(topic, sent)
        self._images += 1

    def _publisher(self, name: str, kind: str) -> Callable[[bytes], None]:
        topic = self._messages.topic(name, kind)
        self.published.append(topic)
        return self._node.publisher(topic)

    def _subscribe(self, name: str, kind: str, handle: Callable[[Any], None], capacity: int) -> None:
        topic = self._messages.topic(name, kind)
        self.taken.append(topic)
        self._node.subscribe(topic, self._sink(topic, handle), capacity)

    def _sink(self, topic: RosTopic, handle: Callable[[Any], None]) -> Sink:
        def sink(key: str, payload: bytes, received_ns: int) -> None:
            try:
                handle(self._messages.decoded(payload, topic.type))
            except (FieldposeError, ValueError) as error:
                self._throttle.warning("a message of ROS is left out", topic=topic.name, why=str(error))

        return sink


class NextFrame:
    """The number of the frame after the newest, by the last step between two; None before any has come."""

    def __init__(self) -> None:
        self.next: int | None = None
        self._newest: int | None = None

    def seen(self, number: int) -> None:
        step = 1 if self._newest is None else number - self._newest
        self._newest, self.next = number, number + max(step, 1)


def _latency_ms(state: State, received_ns: int) -> float | None:
    """Since the capture; None where stamps are by another clock, as a simulation's or a bag's that is played."""
    since_ns = received_ns - state.header.capture_ns
    return since_ns / 1e6 if 0 <= since_ns < _LATEST_NS else None


def _differs(before: State | None, now: State | None) -> bool:
    return (before and before.state) != (now and now.state)
