"""A node in the graph of ROS 2 over Zenoh: its keys, its attachments, and the tokens by which others find it.

Source: docs/design.md, liveliness_utils.cpp and attachment_helpers.cpp of ros2/rmw_zenoh; for plain keys, the README of
eclipse-zenoh/zenoh-plugin-ros2dds.
"""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import zenoh
from zenoh.ext import Int64, z_serialize

from fieldpose.bus.protocol import Sink
from fieldpose.bus.transport import checked_endpoint, feed, open_session, zenoh_reason
from fieldpose.errors import ConfigError, TransportError

Keys = Literal["rmw_zenoh", "ros2dds"]
NO_HASH = "TypeHashNotSupported"
"""Stands for a type's hash in Humble, which has none."""
_NAME = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_ROUTER_MS = 5000
_DOMAINS = range(233)
# Reliable, volatile, the last 10: what differs from rmw_zenoh's own defaults, and what does not is left empty.
_QOS = "::,10:,:,:,,"
_ROOT = "%"
_NODE_ID = 0


@dataclass(frozen=True)
class RosTopic:
    """A topic by its full name (/pose), its type (geometry_msgs/msg/Pose) and the type's hash (RIHS01_...)."""

    name: str
    type: str
    hash: str

    @property
    def dds_type(self) -> str:
        """The type as DDS, and so rmw_zenoh, names it."""
        package, _, kind = self.type.split("/")
        return f"{package}::msg::dds_::{kind}_"


@dataclass(frozen=True)
class RosNames:
    """A node's names: its domain, its namespace (/ or /robot) and its name. Raises ConfigError for what ROS refuses."""

    domain: int = 0
    namespace: str = "/"
    node: str = "fieldpose"
    keys: Keys = "rmw_zenoh"

    def __post_init__(self) -> None:
        if self.domain not in _DOMAINS:
            raise ConfigError(f"ROS domain {self.domain}: expected 0 to {_DOMAINS[-1]}")
        if self.namespace != "/":
            _check_name("namespace", self.namespace)
        _check_name("node", f"/{self.node}")

    def resolved(self, name: str) -> str:
        """The full name of a topic: a relative one lies in the node's namespace. Raises ConfigError."""
        full = name if name.startswith("/") else f"{self.namespace.rstrip('/')}/{name}"
        _check_name("topic", full)
        return full

    def key(self, topic: RosTopic) -> str:
        """Where the topic's messages are sent."""
        name = topic.name.strip("/")
        return name if self.keys == "ros2dds" else f"{self.domain}/{name}/{topic.dds_type}/{topic.hash}"

    def node_token(self, session: str) -> str:
        """The token of the node, of a session with that id."""
        return f"{self._space(session)}/{_NODE_ID}/NN/{self._named()}"

    def topic_token(self, session: str, entity: int, kind: Literal["MP", "MS"], topic: RosTopic) -> str:
        """The token of a publisher (MP) or a subscription (MS), the node's entity of that number."""
        what = f"{_mangled(topic.name)}/{topic.dds_type}/{topic.hash}/{_QOS}"
        return f"{self._space(session)}/{entity}/{kind}/{self._named()}/{what}"

    def _space(self, session: str) -> str:
        return f"@ros2_lv/{self.domain}/{session}/{_NODE_ID}"

    def _named(self) -> str:
        return f"{_ROOT}/{_mangled(self.namespace)}/{self.node}"


def gid_of(token: str) -> bytes:
    """The 16 bytes by which rmw_zenoh knows the holder of a token: its XXH3, the lower half first."""
    from xxhash import xxh3_128_intdigest

    return int(xxh3_128_intdigest(token.encode())).to_bytes(16, "little")


def attachment(number: int, sent_ns: int, gid: bytes) -> bytes:
    """What rmw_zenoh has with each message: its number from 1, when it was sent, and its sender."""
    return bytes(z_serialize((Int64(number), Int64(sent_ns), gid)).to_bytes())


class RosNode:
    """A node of its own session, a client of the router that ROS' nodes meet at.

    Raises TransportError where no router answers. Tokens and attachments are rmw_zenoh's alone.
    """

    def __init__(self, router: str, names: RosNames) -> None:
        client = {
            "mode": "client",
            "connect/endpoints": [checked_endpoint(router)],
            "connect/timeout_ms": _ROUTER_MS,
            "connect/exit_on_failure": True,
            "transport/shared_memory/enabled": False,
        }
        self._names = names
        self._session = open_session(client, f"no router of ROS at {router}; start rmw_zenohd there, or name another")
        self._entities = 0
        self._closing: list[Callable[[], None]] = []
        if names.keys == "rmw_zenoh":
            self._hold(names.node_token(self._id))

    def publisher(self, topic: RosTopic) -> Callable[[bytes], None]:
        """Announce a publisher; gives what sends a message's CDR bytes, from one thread, and raises TransportError."""
        key = self._names.key(topic)
        gid = self._announced("MP", topic)
        publisher = self._session.declare_publisher(key, congestion_control=zenoh.CongestionControl.DROP)
        self._closing.append(publisher.undeclare)
        sent = 0

        def send(payload: bytes) -> None:
            nonlocal sent
            sent += 1
            try:
                publisher.put(payload, attachment=None if gid is None else attachment(sent, time.time_ns(), gid))
            except zenoh.ZError as error:
                raise TransportError(f"cannot send on {key}: {zenoh_reason(error)}") from error

        return send

    def subscribe(self, topic: RosTopic, sink: Sink, capacity: int) -> None:
        """Announce a subscription and give what comes to `sink`; of what waits for it the newest is kept."""
        self._announced("MS", topic)
        channel: Any = zenoh.handlers.RingChannel(capacity)
        subscriber = self._session.declare_subscriber(self._names.key(topic), channel)
        thread = threading.Thread(target=feed, args=(subscriber.handler, sink), name=f"ros {topic.name}", daemon=True)
        thread.start()

        def end() -> None:
            subscriber.undeclare()
            thread.join()

        self._closing.append(end)

    def close(self) -> None:
        """Leave the graph."""
        for close in reversed(self._closing):
            close()
        self._session.close()

    @property
    def _id(self) -> str:
        return str(self._session.zid())

    def _announced(self, kind: Literal["MP", "MS"], topic: RosTopic) -> bytes | None:
        """Hold the token of an entity; gives its gid, None where the keys know no such thing."""
        if self._names.keys == "ros2dds":
            return None
        self._entities += 1
        token = self._names.topic_token(self._id, self._entities, kind, topic)
        self._hold(token)
        return gid_of(token)

    def _hold(self, token: str) -> None:
        self._closing.append(self._session.liveliness().declare_token(token).undeclare)


def _check_name(what: str, name: str) -> None:
    if not _NAME.fullmatch(name):
        raise ConfigError(f"{what} {name!r} is no name in ROS; expected for instance /camera/pose")


def _mangled(name: str) -> str:
    return name.replace("/", _ROOT)
