"""A pipeline in ROS 2: what its messages hold, how sure they say a pose is, and that a ROS node hears and is heard.

There is no ROS here: rosbags reads the messages, and zenoh-ros2-sdk, which has been written against rmw_zenoh by
others, is the node at the other end.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation
from support.commands import command, save_empty_field
from support.tracking_world import on_sphere
from zenoh_ros2_sdk import ROS2Publisher, ROS2Subscriber
from zenoh_ros2_sdk.attachment import Attachment
from zenoh_ros2_sdk.discovery import get_topic_names_and_types
from zenoh_ros2_sdk.entity import EndpointEntity, EntityKind, NodeEntity
from zenoh_ros2_sdk.keyexpr import endpoint_liveliness_keyexpr, node_liveliness_keyexpr, topic_keyexpr
from zenoh_ros2_sdk.qos import QosProfile
from zenoh_ros2_sdk.session import ZenohSession

from fieldpose.bus.messages import Frame, Prior, Reason, State, TrackingState
from fieldpose.bus.ports import Inbox, Outbox, first_header
from fieldpose.bus.protocol import Closer, Closing
from fieldpose.bus.ros2 import RosNames, RosTopic, attachment, gid_of
from fieldpose.bus.topics import FRAME, PRIOR, STATE, Address
from fieldpose.bus.transport import ZenohBus, serve_hub
from fieldpose.deploy.bridges.ros2 import NextFrame, RosBridge, RosTopics, _latency_ms
from fieldpose.deploy.bridges.ros_messages import (
    BODY_FROM_OPTICAL,
    DIAGNOSTICS,
    ODOMETRY,
    POSE,
    TF,
    Frames,
    RosMessages,
    is_published,
    object_in_ros,
    pose_in_ros,
)
from fieldpose.deploy.cli import main, parse
from fieldpose.deploy.commands import bridge
from fieldpose.deploy.processes.endpoints import free_port
from fieldpose.deploy.scene import demo_file
from fieldpose.errors import ConfigError, GeometryError
from fieldpose.stages.geometry import exp_se3, inverse

STORE = get_typestore(Stores.ROS2_JAZZY)
CAPTURE_NS = 1_700_000_000_123_456_789
HASHES = {
    POSE: "RIHS01_26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e",
    ODOMETRY: "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
    TF: "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    DIAGNOSTICS: "RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
}
WAIT_S = 20.0
CAM_FROM_OBJECT = on_sphere(30, 40)
MOUNT = (0.3, -0.1, 0.5, 0.1, -0.2, 1.2)
FAR = (6.0, -4.0, 9.0, 0.1, -0.2, 1.2)
"""A camera ten metres from the base, which its rotation moves more than its translation does."""


def covariance(scale: float = 1.0) -> np.ndarray:
    """Of no special form, positive definite, about a centimetre and a degree."""
    mixed = np.random.default_rng(5).normal(size=(6, 6)) * 0.008 * scale
    return mixed @ mixed.T + 1e-6 * np.eye(6)


def state(kind: TrackingState = TrackingState.TRACKING, frame_id: int = 7, **changes: Any) -> State:
    values: dict[str, Any] = {
        "score": 0.9, "cam_from_object": CAM_FROM_OBJECT, "covariance": covariance(), "in_flight": 0, "admitted": 12,
        "finished": 11, "dropped_at_the_door": 1, "lost": 2,
    }  # fmt: skip
    return State(header=first_header(frame_id, CAPTURE_NS), state=kind, **{**values, **changes})


def read(payload: bytes, kind: str) -> Any:
    return STORE.deserialize_cdr(payload, kind)


def matrix(place: Any, turned: Any) -> np.ndarray:
    result = np.eye(4)
    result[:3, :3] = Rotation.from_quat([turned.x, turned.y, turned.z, turned.w]).as_matrix()
    result[:3, 3] = (place.x, place.y, place.z)
    return result


@pytest.fixture(scope="module")
def drawn() -> np.ndarray:
    """(n, 4, 4): exponentials of twists that were drawn."""
    twists = np.random.default_rng(1).multivariate_normal(np.zeros(6), covariance(), 20_000)
    return np.stack([exp_se3(twist) for twist in twists])


@pytest.mark.parametrize("metres", [1.0, 0.25])
@pytest.mark.parametrize("of", ["camera", "object"])
@pytest.mark.parametrize("mounted", [{}, {"base": "b"}, {"base": "b", "mount": MOUNT}, {"base": "b", "mount": FAR}])
def test_the_covariance_is_that_of_poses_drawn_by_their_twist(
    drawn: np.ndarray, of: Any, mounted: dict[str, Any], metres: float
) -> None:
    base_from_camera = Frames(of=of, **mounted).base_from_camera()
    sent, made = covariance(), pose_in_ros if of == "camera" else object_in_ros
    cam_from_object = exp_se3([1.5, -0.8, 0.4, 0.2, 0.5, -0.3]) @ CAM_FROM_OBJECT
    pose, stated = made(cam_from_object, sent, base_from_camera, metres)
    base_from_object = drawn @ cam_from_object
    base_from_object[:, :3, 3] *= metres
    base_from_object = base_from_camera @ base_from_object
    found = np.linalg.inv(base_from_object) if of == "camera" else base_from_object
    turned = Rotation.from_matrix(found[:, :3, :3] @ pose[:3, :3].T).as_rotvec()
    seen = np.cov(np.hstack([found[:, :3, 3] - pose[:3, 3], turned]).T)
    spread = np.sqrt(np.diag(stated))
    np.testing.assert_allclose(np.sqrt(np.diag(seen)), spread, rtol=0.03)
    np.testing.assert_allclose(seen / np.outer(spread, spread), stated / np.outer(spread, spread), atol=0.03)


def test_a_pose_is_the_camera_in_the_objects_frame() -> None:
    message = read(RosMessages(Frames()).pose(state()), POSE)
    assert message.header.frame_id == "object"
    assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == CAPTURE_NS
    pose = message.pose.pose
    np.testing.assert_allclose(matrix(pose.position, pose.orientation), inverse(CAM_FROM_OBJECT), atol=1e-12)
    expected = pose_in_ros(CAM_FROM_OBJECT, covariance(), np.eye(4), 1.0)[1]
    np.testing.assert_allclose(message.pose.covariance.reshape(6, 6), expected, rtol=1e-12)


def test_a_camera_to_the_side_of_the_object_is_sure_of_its_height() -> None:
    """It stands on x and looks back at the origin: depth, its own z, is along x."""
    cam_from_object = np.array(
        [[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [-1.0, 0.0, 0.0, 3.0], [0.0, 0.0, 0.0, 1.0]]
    )
    pose, stated = pose_in_ros(cam_from_object, np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]), np.eye(4), 2.0)
    np.testing.assert_allclose(pose[:3, 3], [6.0, 0.0, 0.0])
    np.testing.assert_allclose(stated, np.diag([12.0, 4.0, 8.0, 6.0, 4.0, 5.0]))


def test_odometry_says_that_velocities_are_not_known() -> None:
    message = read(RosMessages(Frames()).odometry(state()), ODOMETRY)
    assert (message.header.frame_id, message.child_frame_id) == ("object", "camera_optical_frame")
    pose = message.pose.pose
    np.testing.assert_allclose(matrix(pose.position, pose.orientation), inverse(CAM_FROM_OBJECT), atol=1e-12)
    assert message.twist.covariance.reshape(6, 6).diagonal().min() == 1e6


def test_transforms_lead_to_the_camera_by_way_of_its_body() -> None:
    (alone,) = read(RosMessages(Frames()).tf(state()), TF).transforms
    assert (alone.header.frame_id, alone.child_frame_id) == ("object", "camera_optical_frame")
    first, second = read(RosMessages(Frames(base="camera_link")).tf(state()), TF).transforms
    assert (first.header.frame_id, first.child_frame_id) == ("object", "camera_link")
    assert (second.header.frame_id, second.child_frame_id) == ("camera_link", "camera_optical_frame")
    turned = second.transform.rotation
    np.testing.assert_allclose(np.abs([turned.x, turned.y, turned.z, turned.w]), 0.5)
    through = [matrix(t.transform.translation, t.transform.rotation) for t in (first, second)]
    np.testing.assert_allclose(through[0] @ through[1], inverse(CAM_FROM_OBJECT), atol=1e-12)
    # The body's x is where the camera looks.
    np.testing.assert_allclose(through[0][:3, 0], CAM_FROM_OBJECT[2, :3], atol=1e-12)
    (robot,) = read(RosMessages(Frames(base="base_link", mount=MOUNT), 0.5).tf(state()), TF).transforms
    assert robot.child_frame_id == "base_link"
    base_from_camera = Frames(base="base_link", mount=MOUNT).base_from_camera()
    found = matrix(robot.transform.translation, robot.transform.rotation) @ base_from_camera
    np.testing.assert_allclose(found[:3, 3], 0.5 * inverse(CAM_FROM_OBJECT)[:3, 3], atol=1e-12)


def test_an_object_is_published_below_the_camera_of_a_robot() -> None:
    frames = Frames(of="object", map="part")
    message = read(RosMessages(frames, 0.5).pose(state()), POSE)
    assert message.header.frame_id == "camera_optical_frame"
    in_metres = CAM_FROM_OBJECT.copy()
    in_metres[:3, 3] *= 0.5
    pose = message.pose.pose
    np.testing.assert_allclose(matrix(pose.position, pose.orientation), in_metres, atol=1e-12)
    stated = object_in_ros(CAM_FROM_OBJECT, covariance(), np.eye(4), 0.5)[1]
    np.testing.assert_allclose(message.pose.covariance.reshape(6, 6), stated, rtol=1e-12)
    odometry = read(RosMessages(frames).odometry(state()), ODOMETRY)
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("camera_optical_frame", "part")
    for mount in (None, MOUNT):
        # The robot's own description tells where its camera is.
        robot = Frames(of="object", base="base_link", mount=mount)
        (only,) = read(RosMessages(robot).tf(state()), TF).transforms
        assert (only.header.frame_id, only.child_frame_id) == ("base_link", "object")
        found = matrix(only.transform.translation, only.transform.rotation)
        np.testing.assert_allclose(found, robot.base_from_camera() @ CAM_FROM_OBJECT, atol=1e-12)


def test_a_mount_is_read_as_urdf_has_it() -> None:
    yawed = Frames(base="b", mount=(1.0, 2.0, 3.0, 0.0, 0.0, np.pi / 2)).base_from_camera()
    # A camera that looks to the left of the robot: its z is the robot's y.
    np.testing.assert_allclose(yawed[:3, 2], [0.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(yawed[:3, 3], [1.0, 2.0, 3.0])
    np.testing.assert_allclose(BODY_FROM_OPTICAL[:3, 2], [1.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("kind", "changes", "level", "said"),
    [
        (TrackingState.TRACKING, {}, 0, "tracking"),
        (TrackingState.LIMITED, {"reason": Reason.TOO_FEW_MATCHES}, 1, "limited: too_few_matches"),
        (TrackingState.INITIALIZING, {"cam_from_object": None, "covariance": None}, 1, "initializing"),
        (TrackingState.LOST, {"cam_from_object": None, "covariance": None}, 2, "lost"),
    ],
)
def test_diagnostics_say_how_tracking_is(kind: TrackingState, changes: dict[str, Any], level: int, said: str) -> None:
    told = RosMessages(Frames()).diagnostics("mug/cam", CAPTURE_NS, state(kind, **changes), 12.34)
    (status,) = read(told, DIAGNOSTICS).status
    assert (status.level, status.message, status.name, status.hardware_id) == (level, said, "fieldpose: mug/cam", "cam")
    values = {value.key: value.value for value in status.values}
    assert (values["state"], values["score"], values["latency_ms"], values["frame"]) == (kind, "0.900", "12.3", "7")


def test_diagnostics_without_a_state_are_stale() -> None:
    (status,) = read(RosMessages(Frames()).diagnostics("mug/cam", CAPTURE_NS, None, None), DIAGNOSTICS).status
    assert (status.level, status.message) == (3, "nothing is heard of tracking")


def test_only_what_tracking_is_sure_of_is_a_pose() -> None:
    late = state()
    late.header = first_header(7, 2**31 * 10**9)  # ROS' stamps end there
    assert is_published(state())
    assert not is_published(state(score=0.0))
    assert not is_published(state(covariance=None))
    assert not is_published(late)
    assert not any(is_published(state(kind)) for kind in TrackingState if kind is not TrackingState.TRACKING)


@pytest.mark.parametrize(
    "frames", [Frames(), Frames(base="base_link", mount=MOUNT), Frames(of="object", base="base_link", mount=MOUNT)]
)
def test_a_pose_that_comes_back_is_the_cameras(frames: Frames) -> None:
    messages = RosMessages(frames, 0.5)
    found = messages.guess(messages.decoded(messages.pose(state()), POSE))
    np.testing.assert_allclose(found, CAM_FROM_OBJECT, atol=1e-12)
    with pytest.raises(GeometryError, match=f"a guess in frame '{frames.parent}', but poses are in 'map'"):
        RosMessages(Frames(map="map")).guess(messages.decoded(messages.pose(state()), POSE))
    zero = messages.decoded(messages.pose(state()), POSE)
    zero.pose.pose.orientation.x = zero.pose.pose.orientation.w = 0.0
    with pytest.raises(GeometryError, match="whose length is not 1"):
        messages.guess(zero)
    with pytest.raises(ConfigError, match="3 bytes are no geometry_msgs/msg/PoseWithCovarianceStamped"):
        messages.decoded(b"abc", POSE)


def test_topics_have_the_hashes_of_the_distribution() -> None:
    jazzy, humble = RosMessages(Frames()), RosMessages(Frames(), distro="humble")
    for kind, expected in HASHES.items():
        assert jazzy.topic("/a", kind).hash == expected
        assert humble.topic("/a", kind).hash == "TypeHashNotSupported"
    pose = jazzy.topic("/mug/pose", POSE)
    names = "geometry_msgs::msg::dds_::PoseWithCovarianceStamped_"
    assert RosNames(3).key(pose) == f"3/mug/pose/{names}/{HASHES[POSE]}"
    assert RosNames(3).key(humble.topic("/mug/pose", POSE)) == f"3/mug/pose/{names}/TypeHashNotSupported"
    assert RosNames(keys="ros2dds").key(pose) == "mug/pose"


@pytest.mark.parametrize("namespace", ["/", "/robot/arm"])
def test_tokens_and_keys_are_those_of_another_implementation(namespace: str) -> None:
    names, topic = RosNames(5, namespace, "cam"), RosTopic("/robot/pose", POSE, HASHES[POSE])
    node = NodeEntity(5, "abc123", 0, "cam", namespace)
    qos = QosProfile(history_depth=10).encode()
    assert names.key(topic) == topic_keyexpr(5, topic.name, topic.dds_type, topic.hash)
    assert names.node_token("abc123") == node_liveliness_keyexpr(node)
    for kind in (EntityKind.PUBLISHER, EntityKind.SUBSCRIPTION):
        end = EndpointEntity(node, 4, kind, topic.name, topic.dds_type, topic.hash, qos)
        assert names.topic_token("abc123", 4, kind.value, topic) == endpoint_liveliness_keyexpr(end)  # type: ignore[arg-type]
    assert QosProfile.decode(names.topic_token("abc123", 4, "MP", topic).rpartition("/")[2]) == QosProfile()


def test_the_attachment_is_read_by_another_implementation() -> None:
    gid = gid_of("@ros2_lv/0/a/0/0/NN/%/%/cam")
    sent = attachment(3, CAPTURE_NS, gid)
    assert (len(gid), len(sent), sent[16]) == (16, 33, 16)
    assert Attachment.from_bytes(sent) == Attachment(3, CAPTURE_NS, gid)
    # XXH3's own value for nothing, 99aa06d3014798d86001c324468d497f, lower half first as rmw_zenoh copies it.
    assert gid_of("").hex() == "7f498d4624c30160d8984701d306aa99"


def test_a_guess_is_for_the_frame_after_the_newest() -> None:
    numbers = NextFrame()
    assert numbers.next is None
    told = []
    for number in (4, 5, 10, 15, 0):
        numbers.seen(number)
        told.append(numbers.next)
    # A source that sends every fifth frame, and one that has started again.
    assert told == [5, 6, 15, 20, 1]


def test_names_are_resolved_and_checked() -> None:
    assert RosNames(namespace="/robot").resolved("cam/pose") == "/robot/cam/pose"
    assert RosNames(namespace="/robot").resolved("/tf") == "/tf"
    for bad in (
        lambda: RosNames(domain=300),
        lambda: RosNames(node="my cam"),
        lambda: RosNames(namespace="robot"),
        lambda: RosNames().resolved("a//b"),
        lambda: RosNames().resolved("3d/pose"),
        lambda: Frames(map="/object"),
        lambda: Frames(map=""),
        lambda: Frames(map="camera_optical_frame"),
        lambda: Frames(mount=MOUNT),
        lambda: RosMessages(Frames(), metres=0.0),
    ):
        with pytest.raises(ConfigError, match=r"expected|must be|give --frames\.base"):
            bad()


def test_what_cannot_be_bridged_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    nobody = f"tcp/127.0.0.1:{free_port()}"
    assert main(["bridge", "ros2", "--connect", nobody, "--router", nobody]) == 2
    assert f"--connect and --router are both {nobody}; expected the pipeline's hub" in capsys.readouterr().err
    with serving() as hub:
        assert main(["bridge", "ros2", "--connect", hub, "--open", "--router", nobody]) == 2
        said = capsys.readouterr().err
        assert said.startswith(f"fieldpose: no router of ROS at {nobody}; start rmw_zenohd there")
        assert said.count("\n") == 1
        with serving() as router:
            assert main(["bridge", "ros2", "--connect", hub, "--open", "--router", router, "--object", "*"]) == 2
            assert "pipeline */camera0: expected one, without *" in capsys.readouterr().err


def test_without_rosbags_it_says_what_to_install(tmp_path: Path) -> None:
    program = """
import sys
sys.modules["rosbags"] = None
from fieldpose.deploy.cli import main
sys.exit(main(["bridge", "ros2", "--connect", "tcp/127.0.0.1:1", "--router", "tcp/127.0.0.1:2"]))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr == "fieldpose: the bridge needs rosbags and xxhash; pip install 'fieldpose[ros]'\n"


def test_the_length_of_a_unit_is_the_fields_own(tmp_path: Path) -> None:
    def metres(*options: object) -> float:
        arguments = ["ros2", "--connect", "a", "--router", "b", *(str(option) for option in options)]
        return float(parse(bridge.Options, "bridge", arguments).to.metres_of_unit())

    def unit(*options: object) -> str:
        arguments = ["ros2", "--connect", "a", "--router", "b", *map(str, options)]
        return str(parse(bridge.Options, "bridge", arguments).to.unit_in_words())

    assert metres("--field", demo_file("field.safetensors")) == 0.1
    assert metres("--field", demo_file("field.safetensors"), "--metres", 2) == 2.0
    assert metres() == 1.0
    assert "WITHOUT A KNOWN SCALE" in unit()
    assert unit("--metres", 2) == "a unit of the field is 2 m"
    unknown = save_empty_field(tmp_path / "field.safetensors")
    with pytest.raises(ConfigError, match="how long that is in metres is not known; give --metres"):
        metres("--field", unknown)


@contextmanager
def serving(where: str | None = None) -> Iterator[str]:
    """A router of Zenoh, as a pipeline's hub and ROS' rmw_zenohd are."""
    address, stop = where or f"tcp/127.0.0.1:{free_port()}", threading.Event()
    thread = threading.Thread(target=serve_hub, args=(address, None, stop))
    thread.start()
    try:
        yield address
    finally:
        stop.set()
        thread.join()


@contextmanager
def bridged(hub: str, router: str, *options: str) -> Iterator[subprocess.Popen[str]]:
    line = command("bridge", "ros2", "--connect", hub, "--open", "--router", router, *options)
    process = subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("publishes ")
        yield process
        process.send_signal(signal.SIGTERM)
        _, said = process.communicate(timeout=WAIT_S)
        assert process.returncode == 0, said
    finally:
        process.kill()
        process.communicate()


@contextmanager
def joined(hub: str) -> Iterator[ZenohBus]:
    bus = ZenohBus(hub)
    try:
        bus.wait_for_hub(WAIT_S)
        yield bus
    finally:
        bus.close()


class RosAtTheOtherEnd:
    """A ROS node that hears topics and speaks on others."""

    def __init__(self, router: str) -> None:
        self._port = int(router.rpartition(":")[2])
        self.session = ZenohSession.get_instance("127.0.0.1", self._port)
        self._ends: list[Any] = []

    def hears(self, name: str, kind: str) -> list[Any]:
        heard: list[Any] = []
        self._ends.append(ROS2Subscriber(name, kind, heard.append, router_port=self._port, **self._definition(kind)))
        return heard

    def speaks(self, name: str, kind: str) -> Callable[[Any], None]:
        publisher = ROS2Publisher(name, kind, router_port=self._port, **self._definition(kind))
        self._ends.append(publisher)
        fields = publisher.msg_class.__dataclass_fields__
        return lambda message: publisher.publish(
            **{name: getattr(message, name) for name in fields if not name.isupper() and name != "__msgtype__"}
        )

    def senders(self, key: str) -> list[tuple[str, Attachment]]:
        """Of each message on keys like that the key, and what goes with it."""
        found: list[tuple[str, Attachment]] = []

        def note(sample: Any) -> None:
            found.append((str(sample.key_expr), Attachment.from_bytes(sample.attachment.to_bytes())))

        self._ends.append(Closer(self.session.session.declare_subscriber(key, note).undeclare))
        return found

    def tokens(self, rest: str) -> list[str]:
        replies = self.session.liveliness.get(f"@ros2_lv/0/*/*/*/{rest}", timeout=WAIT_S)
        return [str(reply.ok.key_expr) for reply in replies]

    def topics(self) -> dict[str, list[str]]:
        return dict(get_topic_names_and_types(0, "127.0.0.1", self._port))

    def close(self) -> None:
        for end in self._ends:
            end.close()
        self.session.close()

    def _definition(self, kind: str) -> dict[str, Any]:
        definition, _ = STORE.generate_msgdef(kind, ros_version=2)
        return {"msg_definition": definition, "type_hash": STORE.hash_rihs01(kind), "domain_id": 0}


@contextmanager
def ros(router: str) -> Iterator[RosAtTheOtherEnd]:
    end = RosAtTheOtherEnd(router)
    try:
        yield end
    finally:
        end.close()


def until(condition: Callable[[], Any], act: Callable[[], None] = lambda: None) -> None:
    """Act again and again until the condition holds; what begins to listen misses what came before."""
    deadline = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        act()
        time.sleep(0.05)


def test_a_ros_node_hears_what_tracking_is_sure_of() -> None:
    with serving() as hub, serving() as router, bridged(hub, router), joined(hub) as bus, ros(router) as node:
        poses, odometry = node.hears("/fieldpose/pose", POSE), node.hears("/fieldpose/odometry", ODOMETRY)
        transforms, told = node.hears("/tf", TF), node.hears("/diagnostics", DIAGNOSTICS)
        tracking, told_by = Outbox(bus, Address(), "tracking"), node.senders("**")

        def levels() -> set[int]:
            return {status.level for message in told for status in message.status}

        until(lambda: 2 in levels(), lambda: tracking.publish(STATE, state(TrackingState.LOST)))
        until(lambda: 1 in levels(), lambda: tracking.publish(STATE, state(TrackingState.LIMITED)))
        assert (poses, odometry, transforms) == ([], [], [])
        until(lambda: poses and odometry and transforms and 0 in levels(), lambda: tracking.publish(STATE, state()))
        pose = poses[0].pose.pose
        np.testing.assert_allclose(matrix(pose.position, pose.orientation), inverse(CAM_FROM_OBJECT), atol=1e-12)
        assert transforms[0].transforms[0].child_frame_id == "camera_optical_frame"
        (token,) = node.tokens("MP/*/*/fieldpose/%fieldpose%pose/**")
        sent = [sender for key, sender in told_by if key.startswith("0/fieldpose/pose/")]
        assert {sender.gid for sender in sent} == {gid_of(token)}
        assert [sender.sequence_id for sender in sent] == list(range(1, len(sent) + 1))
        assert len(node.tokens("NN/*/*/fieldpose")) == 1
        assert node.topics() == {
            "/fieldpose/pose": [POSE], "/fieldpose/odometry": [ODOMETRY], "/tf": [TF], "/diagnostics": [DIAGNOSTICS],
        }  # fmt: skip


def test_a_router_of_ros_that_returns_is_found_again() -> None:
    address = f"tcp/127.0.0.1:{free_port()}"
    with serving() as hub, joined(hub) as bus, ExitStack() as stack:
        tracking = Outbox(bus, Address(), "tracking")
        with serving(address) as router:
            stack.enter_context(bridged(hub, router))
        with serving(address) as router, ros(router) as node:
            poses = node.hears("/fieldpose/pose", POSE)
            until(lambda: poses, lambda: tracking.publish(STATE, state()))
            assert "/fieldpose/pose" in node.topics()


def test_images_and_guesses_of_a_ros_node_reach_the_pipeline() -> None:
    options = ("--topics.image", "/front/image_raw", "--topics.prior", "/arm/pose")
    with serving() as hub, serving() as router, bridged(hub, router, *options), joined(hub) as bus, ros(router) as node:
        inbox = Inbox(bus, Address(), (FRAME, PRIOR))
        infos = node.speaks("/front/camera_info", "sensor_msgs/msg/CameraInfo")
        images = node.speaks("/front/image_raw", "sensor_msgs/msg/Image")
        poses = node.speaks("/arm/pose", POSE)
        pixels = np.random.default_rng(0).integers(0, 256, (6, 8, 3)).astype(np.uint8)
        guess = read(RosMessages(Frames()).pose(state()), POSE)

        def speak() -> None:
            infos(camera_info())
            images(bgr_image(pixels))
            poses(guess)

        heard: list[Any] = []

        def both() -> bool:
            heard.extend(received.message for received in inbox.drain())
            return {Frame, Prior} <= {type(message) for message in heard}

        until(both, speak)
        frame = next(message for message in heard if isinstance(message, Frame))
        prior = next(message for message in heard if isinstance(message, Prior))
        np.testing.assert_array_equal(frame.image, pixels)
        assert (frame.header.capture_ns, frame.camera.fx, frame.camera.width) == (CAPTURE_NS, 10.0, 8)
        np.testing.assert_allclose(prior.cam_from_object, CAM_FROM_OBJECT, atol=1e-12)
        assert prior.header.frame_id > 0


def header() -> Any:
    stamp = STORE.types["builtin_interfaces/msg/Time"](CAPTURE_NS // 10**9, CAPTURE_NS % 10**9)
    return STORE.types["std_msgs/msg/Header"](stamp, "front")


def bgr_image(rgb: np.ndarray) -> Any:
    height, width = rgb.shape[:2]
    data = np.ascontiguousarray(rgb[..., ::-1]).ravel()
    return STORE.types["sensor_msgs/msg/Image"](header(), height, width, "bgr8", 0, 3 * width, data)


def camera_info() -> Any:
    types, k = STORE.types, np.array([10.0, 0.0, 3.5, 0.0, 10.0, 2.5, 0.0, 0.0, 1.0])
    region = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    return types["sensor_msgs/msg/CameraInfo"](
        header(), 6, 8, "plumb_bob", np.zeros(5), k, np.eye(3).ravel(), np.zeros(12), 0, 0, region
    )


class _Nowhere:
    """A bus and a node of ROS without any wire: keeps what is put on the bus, and the sinks of subscriptions."""

    def __init__(self) -> None:
        self.put_on: list[str] = []
        self.sinks: dict[str, Any] = {}

    def put(self, key: str, payload: bytes, topic: Any) -> None:
        self.put_on.append(topic.name)

    def hold(self, key: str) -> Closing:
        return Closer(lambda: None)

    def publisher(self, topic: RosTopic) -> Callable[[bytes], None]:
        return lambda payload: None

    def subscribe(self, topic: RosTopic, sink: Any, capacity: int) -> None:
        self.sinks[topic.name] = sink


def test_no_image_goes_with_a_camera_that_is_not_its_own(capfd: pytest.CaptureFixture[str]) -> None:
    wires: Any = _Nowhere()
    RosBridge(wires, Address(), wires, RosNames(), RosTopics(image="/front/image_raw"), RosMessages(Frames()))

    def heard(topic: str, message: Any) -> list[str]:
        wires.put_on.clear()
        wires.sinks[f"/front/{topic}"](topic, bytes(STORE.serialize_cdr(message, message.__msgtype__)), 0)
        return list(wires.put_on)

    def images() -> list[str]:
        return heard("image_raw", bgr_image(np.zeros((6, 8, 3), np.uint8)))

    assert images() == []
    heard("camera_info", camera_info())
    assert images() == ["frame", "camera_info"]
    assert heard("image_raw", bgr_image(np.zeros((3, 4, 3), np.uint8))) == []
    assert "an image is 4x3, its CameraInfo is of 8x6" in capfd.readouterr().err
    heard("camera_info", replace(camera_info(), distortion_model="equidistant"))
    assert images() == []
    heard("camera_info", camera_info())
    assert images() == ["frame", "camera_info"]


def test_latency_is_told_where_stamps_are_by_this_clock() -> None:
    assert _latency_ms(state(), CAPTURE_NS + 25_000_000) == 25.0
    assert _latency_ms(state(), CAPTURE_NS - 1) is None
    assert _latency_ms(state(), 3 * CAPTURE_NS) is None


def test_a_bridge_of_plain_keys_sends_cdr_under_the_topics_names() -> None:
    keys = ("--keys", "ros2dds")
    with serving() as hub, serving() as dds, bridged(hub, dds, *keys), joined(hub) as bus, joined(dds) as listener:
        heard: list[bytes] = []
        subscription = listener.subscribe("fieldpose/pose", lambda key, payload, at_ns: heard.append(payload), 8)
        tracking = Outbox(bus, Address(), "tracking")
        until(lambda: heard, lambda: tracking.publish(STATE, state()))
        subscription.close()
        assert read(heard[0], POSE).header.frame_id == "object"
