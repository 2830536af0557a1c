"""A running pipeline as a node of ROS 2."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from fieldpose.bus.ros2 import Keys, RosNames, RosNode
from fieldpose.bus.signals import StopSignals
from fieldpose.bus.topics import Address
from fieldpose.deploy.access.joining import Entry, join
from fieldpose.deploy.access.roles import PROGRAM
from fieldpose.deploy.bridges.ros2 import RosBridge, RosTopics
from fieldpose.deploy.bridges.ros_messages import Distro, Frames, RosMessages, topics_in_words
from fieldpose.errors import ConfigError, UsageError

_HUB_S = 5.0


@dataclass(frozen=True)
class Ros2:
    """Make a pipeline that is running a node of ROS 2, over its middleware rmw_zenoh, until Ctrl-C.

    Example: fieldpose bridge ros2 --connect tcp/127.0.0.1:41234 --router tcp/127.0.0.1:7447

    Poses that tracking is sure of are published as PoseWithCovarianceStamped, Odometry and transforms, of the camera
    (or --frames.base) in the object's frame, or with --frames.of object the other way round, and how tracking is as
    diagnostics. A pipeline's hub and the router of ROS
    are two: both listen on port 7447 where nobody says otherwise, so each is to be named. See docs/ros2.md.
    """

    connect: str
    """Where the pipeline's hub is; `fieldpose run` says it when it starts."""
    router: str
    """Where the router of ROS is: `ros2 run rmw_zenoh_cpp rmw_zenohd`, or the bridge zenoh-bridge-ros2dds."""
    distro: Distro = "jazzy"
    """The distribution of ROS 2; Humble has no hashes of types in its keys."""
    keys: Keys = "rmw_zenoh"
    """rmw_zenoh, or ros2dds: keys are topics' names alone, as zenoh-bridge-ros2dds has them."""
    domain: int = 0
    """ROS_DOMAIN_ID."""
    namespace: str = "/"
    """The node's namespace."""
    node: str = "fieldpose"
    """The node's name."""
    field: Path | None = None
    """The field (.safetensors) that is tracked, for the length of its unit in metres."""
    metres: float | None = None
    """That length instead of the field's; 1 where neither is given."""
    frames: Frames = dataclasses.field(default_factory=Frames)
    topics: RosTopics = dataclasses.field(default_factory=RosTopics)
    entry: Annotated[Entry, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Entry)
    address: Annotated[Address, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Address)
    """Which pipeline."""

    def run(self) -> int:
        """Carry messages until a signal to stop. Raises FieldposeErrors where a hub or router is not there."""
        if self.connect == self.router:
            raise UsageError(
                f"--connect and --router are both {self.connect}; expected the pipeline's hub and the router of ROS, of"
                " which one has to listen on another port"
            )
        metres = self.metres_of_unit()
        messages = RosMessages(self.frames, metres, self.distro)
        names = RosNames(self.domain, self.namespace, self.node, self.keys)
        with StopSignals() as signals:
            bus = join(self.connect, self.entry, (PROGRAM,), _HUB_S)
            try:
                node = RosNode(self.router, names)
                try:
                    bridge = RosBridge(bus, self.address, node, names, self.topics, messages)
                    said = topics_in_words(bridge.published) or "nothing"
                    print(f"publishes {said}; {self.unit_in_words()}", flush=True)
                    if bridge.taken:
                        print(f"takes {topics_in_words(bridge.taken)}", flush=True)
                    bridge.run(signals.stop)
                finally:
                    node.close()
            finally:
                bus.close()
        return 0

    def unit_in_words(self) -> str:
        """How long the field's unit is taken to be."""
        if self.metres is None and self.field is None:
            return "WITHOUT A KNOWN SCALE, the field's unit is taken for 1 m: give --field or --metres"
        return f"a unit of the field is {self.metres_of_unit():g} m"

    def metres_of_unit(self) -> float:
        """Length of the field's unit. Raises ConfigError where the field does not know it, and FieldFileError."""
        if self.metres is not None or self.field is None:
            return 1.0 if self.metres is None else self.metres
        from fieldpose.stages.nerf.field import load_metadata

        metadata = load_metadata(self.field)
        if metadata.metres_per_unit is None:
            raise ConfigError(
                f"{self.field}: lengths are in the {metadata.unit}, and how long that is in metres is not known; give"
                " --metres, or the field a scale with `fieldpose frame`"
            )
        return metadata.metres_per_unit
