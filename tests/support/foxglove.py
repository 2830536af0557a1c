"""Reading what was written or sent in Foxglove's schemas, by MCAP's own library and a plain WebSocket."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.reader import make_reader
from mcap.records import Schema
from mcap_protobuf.decoder import DecoderFactory
from scipy.spatial.transform import Rotation
from websockets.sync.client import ClientConnection

CLOUD = np.dtype(
    [
        ("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1"), ("alpha", "u1"),
        ("confidence", "<f4"), ("consistency", "<f4"), ("kept", "u1"),
    ]
)  # fmt: skip
_MESSAGE_DATA = 1


class Read(NamedTuple):
    """A message: a dict where its channel has JSON."""

    content: Any
    log_ns: int
    publish_ns: int


class Decoders:
    """Decodes messages by the schemas that come with them."""

    def __init__(self) -> None:
        self._factory = DecoderFactory()

    def decode(self, encoding: str, schema: Schema, payload: bytes) -> Any:
        if encoding == "json":
            return json.loads(payload)
        decoder = self._factory.decoder_for(encoding, schema)
        assert decoder is not None, (encoding, schema.name)
        return decoder(payload)


def read_mcap(path: Path) -> dict[str, list[Read]]:
    """topic -> its messages, in the order of their log times."""
    decoders, found = Decoders(), dict[str, list[Read]]()
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
            assert schema is not None
            content = decoders.decode(channel.message_encoding, schema, message.data)
            found.setdefault(channel.topic, []).append(Read(content, message.log_time, message.publish_time))
    return found


@dataclass
class Client:
    """A client of the protocol foxglove.sdk.v1."""

    socket: ClientConnection
    decoders: Decoders = field(default_factory=Decoders)
    channels: dict[str, dict[str, Any]] = field(default_factory=dict)
    subscribed: dict[int, str] = field(default_factory=dict)

    def wait_for_channels(self, timeout_s: float) -> None:
        """Take in what is advertised first."""
        while not self.channels:
            said = json.loads(self.socket.recv(timeout_s))
            if said["op"] == "advertise":
                self.channels = {channel["topic"]: channel for channel in said["channels"]}

    def subscribe(self, *topics: str) -> None:
        asked = []
        for topic in topics:
            number = len(self.subscribed) + 1
            self.subscribed[number] = topic
            asked.append({"id": number, "channelId": self.channels[topic]["id"]})
        self.socket.send(json.dumps({"op": "subscribe", "subscriptions": asked}))

    def messages(self, timeout_s: float) -> Iterator[tuple[str, Any, int]]:
        """Topic, content and log time of each message; raises TimeoutError where none comes in time."""
        while True:
            said = self.socket.recv(timeout_s)
            if isinstance(said, str):
                continue
            kind, number, log_ns = struct.unpack_from("<BIQ", said)
            assert kind == _MESSAGE_DATA
            channel = self.channels[self.subscribed[number]]
            data = channel["schema"].encode()
            if channel["schemaEncoding"] == "protobuf":
                data = base64.b64decode(data)
            schema = Schema(id=channel["id"], name=channel["schemaName"], encoding=channel["schemaEncoding"], data=data)
            yield channel["topic"], self.decoders.decode(channel["encoding"], schema, said[13:]), log_ns


def rigid(position: Any, orientation: Any) -> np.ndarray:
    """The transform (4, 4) of a position and a quaternion."""
    result = np.eye(4)
    turn = [orientation.x, orientation.y, orientation.z, orientation.w]
    result[:3, :3] = Rotation.from_quat(turn).as_matrix()
    result[:3, 3] = position.x, position.y, position.z
    return result


def when(timestamp: Any) -> int:
    """Nanoseconds since the epoch."""
    return int(timestamp.seconds) * 10**9 + int(timestamp.nanos)


def groups(annotations: Any) -> dict[str, np.ndarray]:
    """What points are -> their places (n, 2) in the image."""
    return {
        group.metadata[0].value: np.array([(point.x, point.y) for point in group.points])
        for group in annotations.points
    }
