"""A running pipeline over Foxglove's WebSocket, for whoever looks."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from types import TracebackType

import foxglove

from fieldpose.bus.ports import Inbox
from fieldpose.bus.protocol import Bus
from fieldpose.bus.topics import ALL as TOPICS
from fieldpose.bus.topics import FRAME, Address
from fieldpose.deploy.foxglove import channels
from fieldpose.deploy.foxglove.channels import Channel
from fieldpose.deploy.foxglove.converter import Converted, Converter
from fieldpose.errors import OutputError, TransportError

PICTURES_HZ = 10.0
_POLL_S = 0.1
_FRAMES = 8
_WAITING = 128
"""Messages kept for a client that does not read: the SDK's own 1024 are a gigabyte of depth images."""


class Server:
    """Serves every channel on `host` and `port`, 0 for a free one. Raises TransportError where it cannot listen there.

    Nothing but what a client has subscribed to is wanted, and of each channel of pictures no more than PICTURES_HZ.
    """

    def __init__(self, host: str, port: int, name: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._shown_at: dict[Channel, float] = {}
        self._context = foxglove.Context()  # the server and the channels do not keep it
        self._channels = {channel: _served(channel, self._context) for channel in channels.ALL}
        try:
            self._server = foxglove.start_server(
                name=name, host=host, port=port, context=self._context, message_backlog_size=_WAITING
            )
        except (RuntimeError, OverflowError) as error:
            why = str(error).removeprefix("FoxgloveError: ")
            raise TransportError(f"cannot serve on {host}:{port}: {why}; choose others with --host, --port") from error

    @property
    def port(self) -> int:
        """Where it listens."""
        return self._server.port

    def wanted(self, channel: Channel) -> bool:
        """Whether a message of this channel would be sent to anybody now."""
        if not self._channels[channel].has_sinks():
            return False
        if channel.picture:
            now = self._clock()
            if now - self._shown_at.get(channel, -1.0) < 1.0 / PICTURES_HZ:
                return False
            self._shown_at[channel] = now
        return True

    def send(self, message: Converted) -> None:
        """Send a message to those who have subscribed to its channel."""
        self._channels[message.channel].log(message.payload, log_time=message.log_ns)

    def __enter__(self) -> Server:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._server.stop()


class Bridge:
    """Reads a pipeline's topics from the bus, from when it is made on, and sends them to a server."""

    def __init__(self, bus: Bus, address: Address, server: Server) -> None:
        self.messages = self.unreadable = 0
        self._server = server
        self._inbox = Inbox(bus, address, TOPICS, {FRAME: _FRAMES})
        self._converter = Converter(server.wanted)

    def run(self, stop: threading.Event) -> None:
        """Pass on what comes until `stop` is set."""
        try:
            while not stop.is_set():
                received = self._inbox.get(_POLL_S)
                if received is None:
                    continue
                self.messages += 1
                try:
                    for message in self._converter.convert(received.topic, received.message):
                        self._server.send(message)
                except OutputError:
                    self.unreadable += 1
        finally:
            self._inbox.close()


def _served(channel: Channel, context: foxglove.Context) -> foxglove.Channel:
    name, encoding, data = channel.schema
    schema = foxglove.Schema(name=name, encoding=encoding, data=data)
    return foxglove.Channel(channel.topic, schema=schema, message_encoding=channel.encoding, context=context)
