"""From what tracking believes to the messages of ROS 2, and back from a pose of ROS to a guess; no input or output.

ROS has the pose of a frame in its parent, in metres, and its covariance in the order x y z and rotation about x y z, of
small changes along and about the fixed axes of the parent (REP 103).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from fieldpose.bus.messages import State, TrackingState
from fieldpose.bus.ros2 import NO_HASH, RosTopic
from fieldpose.errors import ConfigError, GeometryError
from fieldpose.stages.geometry import RIGID_TOLERANCE, adjoint, inverse, is_rigid
from fieldpose.stages.geometry.rigid import from_rotation, skew

Distro = Literal["humble", "jazzy", "kilted", "lyrical"]
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
ODOMETRY = "nav_msgs/msg/Odometry"
TF = "tf2_msgs/msg/TFMessage"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
BODY_FROM_OPTICAL = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""From OpenCV's axes (x right, y down, z forward) to those of a body (x forward, y left, z up); REP 103."""
_UNKNOWN_VARIANCE = 1e6
_STAMPS_NS = 2**31 * 10**9
_LEVELS = {
    TrackingState.TRACKING: 0,
    TrackingState.LIMITED: 1,
    TrackingState.INITIALIZING: 1,
    TrackingState.LOST: 2,
}
_STALE = 3


@dataclass(frozen=True)
class Frames:
    """Names of frames, and where the camera is mounted. Raises ConfigError for names that tf2 refuses."""

    of: Literal["camera", "object"] = "camera"
    """Whose pose is published: the camera's (or the base's) in the object's frame, as of a robot in a map; or the
    object's in the camera's (or the base's), as of a part to be grasped, where the camera has a parent already."""
    map: str = "object"
    """The object's frame."""
    camera: str = "camera_optical_frame"
    """The camera's, in OpenCV's axes: x right, y down, z forward."""
    base: str | None = None
    """A body's, x forward, y left, z up; poses are then of it, and the camera's pose follows from the mount."""
    mount: tuple[float, float, float, float, float, float] | None = None
    """x y z roll pitch yaw, in metres and radians, of the camera's own body (x forward) in the base, as URDF has them;
    the robot's description tells then where the camera is. Without it the base is the camera's own body."""

    def __post_init__(self) -> None:
        names = [self.map, self.camera, *([] if self.base is None else [self.base])]
        for name in names:
            if not name or name.startswith("/") or any(c.isspace() for c in name):
                raise ConfigError(f"frame {name!r}: expected a name without spaces, and without / at its start")
        if len(set(names)) < len(names):
            raise ConfigError(f"frames {', '.join(names)}: expected names that differ")
        if self.mount is not None and self.base is None:
            raise ConfigError("frames: a mount says where the camera is in a base; give --frames.base too")

    @property
    def child(self) -> str:
        """The frame whose pose is published."""
        return self._body if self.of == "camera" else self.map

    @property
    def parent(self) -> str:
        """The frame that it is in."""
        return self.map if self.of == "camera" else self._body

    @property
    def _body(self) -> str:
        return self.base or self.camera

    def base_from_camera(self) -> np.ndarray:
        """(4, 4), in metres; where there is no base it is the camera itself."""
        if self.base is None:
            return np.eye(4)
        if self.mount is None:
            return BODY_FROM_OPTICAL
        from scipy.spatial.transform import Rotation

        return from_rotation(Rotation.from_euler("xyz", self.mount[3:]), self.mount[:3]) @ BODY_FROM_OPTICAL


def is_published(state: State) -> bool:
    """Whether a state is published as a pose: tracking is sure of it, and of how sure it is, at a time that ROS has."""
    return state.is_sure and state.covariance is not None and state.header.capture_ns < _STAMPS_NS


def pose_in_ros(
    cam_from_object: np.ndarray, covariance: np.ndarray, base_from_camera: np.ndarray, metres: float
) -> tuple[np.ndarray, np.ndarray]:
    """object_from_base (4, 4) in metres, and the covariance (6, 6) of its position and rotation about fixed axes.

    covariance: of the left twist of cam_from_object, in field units; metres: of one of those. A twist of the camera
    moves what it sees, so that object_from_cam is multiplied by its inverse from the right, and it acts in the camera's
    axes: seen from the base it is transformed by the adjoint, and the object's axes see it turned.
    """
    scale = np.diag([metres, metres, metres, 1.0, 1.0, 1.0])
    object_from_cam = inverse(cam_from_object)
    object_from_cam[:3, 3] *= metres
    object_from_base = object_from_cam @ inverse(base_from_camera)
    turn = np.kron(np.eye(2), object_from_base[:3, :3])
    moved = turn @ adjoint(base_from_camera) @ scale
    return object_from_base, moved @ covariance @ moved.T


def object_in_ros(
    cam_from_object: np.ndarray, covariance: np.ndarray, base_from_camera: np.ndarray, metres: float
) -> tuple[np.ndarray, np.ndarray]:
    """base_from_object (4, 4) in metres, and the covariance (6, 6) of its position and rotation about fixed axes.

    covariance, metres: see pose_in_ros. A left twist turns about the base's origin, and so moves what is away from it.
    """
    scale = np.diag([metres, metres, metres, 1.0, 1.0, 1.0])
    in_metres = cam_from_object.copy()
    in_metres[:3, 3] *= metres
    base_from_object = base_from_camera @ in_metres
    lever = np.eye(6)
    lever[:3, 3:] = -skew(base_from_object[:3, 3])
    moved = lever @ adjoint(base_from_camera) @ scale
    return base_from_object, moved @ covariance @ moved.T


def cam_from_object_of(base_from_object: np.ndarray, base_from_camera: np.ndarray, metres: float) -> np.ndarray:
    """The camera's pose (4, 4) in field units, of where a body has the object in metres."""
    cam_from_object = inverse(base_from_camera) @ base_from_object
    cam_from_object[:3, 3] /= metres
    return cam_from_object


class RosMessages:
    """Makes the CDR bytes of each topic for a distribution of ROS 2.

    metres: of one unit of the field. Raises ConfigError where it is not above 0, or rosbags is not installed.
    """

    def __init__(self, frames: Frames, metres: float = 1.0, distro: Distro = "jazzy") -> None:
        if not 0 < metres < np.inf:
            raise ConfigError(f"metres of a field unit: {metres:g}, but must be more than 0")
        try:
            import xxhash  # noqa: F401
            from rosbags.typesys import Stores, get_typestore
        except ImportError as error:
            raise ConfigError("the bridge needs rosbags and xxhash; pip install 'fieldpose[ros]'") from error
        self.frames, self._metres, self._distro = frames, metres, distro
        self._store = get_typestore(Stores(f"ros2_{distro}"))
        self._base_from_camera = frames.base_from_camera()

    def topic(self, name: str, kind: str) -> RosTopic:
        """A topic of that full name and type, with the type's hash as this distribution has it."""
        return RosTopic(name, kind, NO_HASH if self._distro == "humble" else self._store.hash_rihs01(kind))

    def decoded(self, payload: bytes, kind: str) -> Any:
        """A message of that type. Raises ConfigError for bytes that are none."""
        try:
            return self._store.deserialize_cdr(payload, kind)
        except Exception as error:  # what damaged bytes raise is not told by rosbags
            raise ConfigError(f"{len(payload)} bytes are no {kind}: {' '.join(str(error).split())}") from error

    def pose(self, state: State) -> bytes:
        """PoseWithCovarianceStamped of a sure state."""
        return self._encoded(self._new(POSE, header=self._header(state), pose=self._pose(state)))

    def odometry(self, state: State) -> bytes:
        """Odometry of a sure state; velocities are not known, which their variances say."""
        vector = self._new("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        twist = self._new(
            "geometry_msgs/msg/TwistWithCovariance",
            twist=self._new("geometry_msgs/msg/Twist", linear=vector, angular=vector),
            covariance=np.diag([_UNKNOWN_VARIANCE] * 6).ravel(),
        )
        return self._encoded(
            self._new(
                ODOMETRY, header=self._header(state), child_frame_id=self.frames.child, pose=self._pose(state),
                twist=twist,
            )
        )  # fmt: skip

    def tf(self, state: State) -> bytes:
        """TFMessage of a sure state: parent to child, and base to camera where the base is the camera's own body."""
        parent_from_child, _ = self._in_ros(state)
        frames = self.frames
        transforms = [self._transform(state, frames.parent, frames.child, parent_from_child)]
        if frames.of == "camera" and frames.base is not None and frames.mount is None:
            transforms.append(self._transform(state, frames.base, frames.camera, self._base_from_camera))
        return self._encoded(self._new(TF, transforms=transforms))

    def diagnostics(self, pipeline: str, now_ns: int, state: State | None, latency_ms: float | None) -> bytes:
        """DiagnosticArray: OK while tracking is sure, WARN, ERROR where it is lost, and STALE without a state."""
        if state is None:
            level, said, values = _STALE, "nothing is heard of tracking", {}
        else:
            level, said = _LEVELS[state.state], str(state.state)
            said = said if state.reason is None else f"{said}: {state.reason}"
            values = {
                "state": str(state.state), "score": f"{state.score:.3f}", "reason": str(state.reason or ""),
                "latency_ms": "" if latency_ms is None else f"{latency_ms:.1f}",
                "frame": str(state.header.frame_id), "camera_origin": str(state.camera_origin),
                "frames": str(state.admitted), "dropped_at_the_door": str(state.dropped_at_the_door),
                "lost": str(state.lost),
            }  # fmt: skip
        status = self._new(
            "diagnostic_msgs/msg/DiagnosticStatus", level=level, name=f"fieldpose: {pipeline}", message=said,
            hardware_id=pipeline.partition("/")[2],
            values=[self._new("diagnostic_msgs/msg/KeyValue", key=key, value=value) for key, value in values.items()],
        )  # fmt: skip
        return self._encoded(self._new(DIAGNOSTICS, header=self._stamped(now_ns, ""), status=[status]))

    def guess(self, message: Any) -> np.ndarray:
        """cam_from_object (4, 4) of a PoseWithCovarianceStamped of the frame that poses are published of.

        Raises GeometryError for numbers that are no pose, and for a pose in another frame than those are in.
        """
        from scipy.spatial.transform import Rotation

        named = message.header.frame_id
        if named != self.frames.parent:
            raise GeometryError(f"a guess in frame {named!r}, but poses are in {self.frames.parent!r}; see --frames")
        pose = message.pose.pose
        turned = np.array([pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w])
        if not abs(np.linalg.norm(turned) - 1.0) < RIGID_TOLERANCE:
            raise GeometryError(f"a guess has the quaternion {turned.tolist()}, whose length is not 1")
        place = (pose.position.x, pose.position.y, pose.position.z)
        given = from_rotation(Rotation.from_quat(turned), place)
        base_from_object = inverse(given) if self.frames.of == "camera" else given
        found = cam_from_object_of(base_from_object, self._base_from_camera, self._metres)
        if not is_rigid(found, RIGID_TOLERANCE):
            raise GeometryError(f"a guess has the position {list(place)}, which is none")
        return found

    def _in_ros(self, state: State) -> tuple[np.ndarray, np.ndarray]:
        if state.cam_from_object is None or state.covariance is None:
            raise ValueError("a state without a pose or its covariance is not published")
        made = pose_in_ros if self.frames.of == "camera" else object_in_ros
        return made(state.cam_from_object, state.covariance, self._base_from_camera, self._metres)

    def _pose(self, state: State) -> Any:
        parent_from_child, covariance = self._in_ros(state)
        x, y, z = parent_from_child[:3, 3].tolist()
        pose = self._new(
            "geometry_msgs/msg/Pose", position=self._new("geometry_msgs/msg/Point", x=x, y=y, z=z),
            orientation=self._quaternion(parent_from_child),
        )  # fmt: skip
        return self._new("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance.ravel())

    def _transform(self, state: State, parent: str, child: str, parent_from_child: np.ndarray) -> Any:
        x, y, z = parent_from_child[:3, 3].tolist()
        transform = self._new(
            "geometry_msgs/msg/Transform", translation=self._new("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
            rotation=self._quaternion(parent_from_child),
        )  # fmt: skip
        header = self._stamped(state.header.capture_ns, parent)
        return self._new("geometry_msgs/msg/TransformStamped", header=header, child_frame_id=child, transform=transform)

    def _quaternion(self, transform: np.ndarray) -> Any:
        from scipy.spatial.transform import Rotation

        x, y, z, w = Rotation.from_matrix(transform[:3, :3]).as_quat(canonical=True).tolist()
        return self._new("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def _header(self, state: State) -> Any:
        return self._stamped(state.header.capture_ns, self.frames.parent)

    def _stamped(self, at_ns: int, frame: str) -> Any:
        stamp = self._new("builtin_interfaces/msg/Time", sec=at_ns // 10**9, nanosec=at_ns % 10**9)
        return self._new("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def _new(self, kind: str, **values: Any) -> Any:
        return self._store.types[kind](**values)

    def _encoded(self, message: Any) -> bytes:
        return bytes(self._store.serialize_cdr(message, message.__msgtype__))


def topics_in_words(topics: Sequence[RosTopic]) -> str:
    """Topics with their types, for people."""
    return ", ".join(f"{topic.name} ({topic.type})" for topic in topics)
