"""The bus between processes and hosts, over Zenoh, which only this module and `questions`, `refusals`, `ros2` know."""

from __future__ import annotations

import json
import re
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import zenoh

from fieldpose.bus import shared_memory
from fieldpose.bus.access import Access, Deed
from fieldpose.bus.memory import MemoryBus
from fieldpose.bus.presence import Presence
from fieldpose.bus.protocol import Answer, Bus, Closer, Closing, Replies, Sink, Watcher, nobody_answers, wait_for
from fieldpose.bus.questions import asked, feed_questions
from fieldpose.bus.signals import StopSignals
from fieldpose.bus.topics import Topic
from fieldpose.errors import TransportError

__all__ = [
    "LOCAL_HUB", "WITHOUT_SHARED_MEMORY", "Bus", "Closing", "MemoryBus", "Sink", "Watcher", "ZenohBus", "serve_hub",
    "wait_for",
]  # fmt: skip

LOCAL_HUB = "tcp/127.0.0.1:7447"
WITHOUT_SHARED_MEMORY = {"transport/shared_memory/enabled": False}
_LOCAL_PEER = "tcp/127.0.0.1:0"
_QUESTIONS = 64
_SIGNAL_S = 0.5
_ASK_AGAIN_S, _LEAST_S = 0.05, 0.01
_ENDPOINT = re.compile(r"[a-z]+/.+:\d{1,5}([?#].*)?")
_PRIORITIES = {"data": zenoh.Priority.DATA, "data_low": zenoh.Priority.DATA_LOW}
_PATIENT = {
    "connect/timeout_ms": -1,
    "connect/exit_on_failure": False,
    "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5},
}
# A message waits this long for a receiver that is busy for a moment; while one takes nothing at all, what is meant
# for it is dropped at once. BLOCK would let it throttle everyone and close its link after 5 s; BLOCK_FIRST lost one
# image in a few hundred to receivers that were not slow at all.
_CONGESTION = zenoh.CongestionControl.DROP
_WAITS_US = {"wait_before_drop": 50_000, "max_wait_before_drop_fragments": 100_000}


class ZenohBus:
    """A bus over Zenoh: a peer that finds the others through the hub, and returns by itself after the hub's death.

    `hub` and `listen` are endpoints ("tcp/host:port", "tls/host:port"); `settings` adds to Zenoh's configuration by
    path. access: of a bus that is closed, whose endpoints are all of TLS; without it everybody is let in who reaches
    the address. Raises TransportError where these cannot be used; a hub that is not there yet is no error, see
    `wait_for_hub`.
    """

    def __init__(
        self, hub: str = LOCAL_HUB, listen: str = _LOCAL_PEER, settings: Mapping[str, Any] | None = None,
        access: Access | None = None,
    ) -> None:  # fmt: skip
        self._hub, self._access = checked_endpoint(hub), access
        peer = {
            "mode": "peer",
            "connect/endpoints": [self._hub],
            **_PATIENT,
            "listen/endpoints": [checked_endpoint(listen)],
        }
        what = f"cannot use hub {hub} and listen on {listen}"
        self._session = open_session({**peer, **closing(access), **(settings or {})}, what)
        self._publishers: dict[str, Any] = {}
        self._declaring = threading.Lock()
        self._mine: list[Closer] = []
        self._presence = self._open_presence(str(self._session.zid()))

    def wait_for_hub(self, timeout_s: float) -> None:
        """Return once the hub answers. Raises TransportError after `timeout_s`."""
        deadline = time.monotonic() + timeout_s
        while not self.has_hub:
            if time.monotonic() > deadline:
                raise TransportError(
                    f"no hub answers at {self._hub} after {timeout_s:g} s; start it, or name its address"
                )
            time.sleep(0.005)

    @property
    def has_hub(self) -> bool:
        """Whether there is a link to the hub now, on which it has been heard of within Zenoh's lease of 2 s."""
        return bool(self._session.info.routers_zid())

    def put(self, key: str, payload: bytes, topic: Topic[Any] | None = None) -> None:
        try:
            with self._declaring:
                publisher = self._publishers.get(key)
                if publisher is None:
                    self._check("send on", key)
                    priority = _PRIORITIES[topic.priority] if topic is not None else zenoh.Priority.DATA
                    publisher = self._session.declare_publisher(key, priority=priority, congestion_control=_CONGESTION)
                    self._publishers[key] = publisher
            publisher.put(payload)
        except zenoh.ZError as error:
            raise TransportError(f"cannot send on {key}: {zenoh_reason(error)}") from error

    def subscribe(self, key: str, sink: Sink, capacity: int) -> Closing:
        self._check("listen to", key)
        channel: Any = zenoh.handlers.RingChannel(1) if capacity == 1 else zenoh.handlers.FifoChannel(capacity)
        subscriber = self._session.declare_subscriber(key, channel)
        # Zenoh's channel keeps the newest while Python is busy; copying out at once frees shared memory.
        thread = threading.Thread(target=feed, args=(subscriber.handler, sink), name=f"feed {key}", daemon=True)
        thread.start()

        def end() -> None:
            subscriber.undeclare()
            thread.join()

        return self._closer(end)

    def serve(self, key: str, answer: Answer) -> Closing:
        self._check("answer at", key)
        # A ring: where Python is kept from running, a full channel must not hold up what else comes over the link.
        queryable = self._session.declare_queryable(key, zenoh.handlers.RingChannel(_QUESTIONS))
        thread = threading.Thread(
            target=feed_questions, args=(queryable.handler, key, answer), name=f"answer {key}", daemon=True
        )
        thread.start()

        def end() -> None:
            queryable.undeclare()
            thread.join()

        return self._closer(end)

    def ask(self, key: str, payload: bytes, timeout_s: float) -> Replies:
        self._check("ask at", key)
        deadline = time.monotonic() + timeout_s
        while True:
            try:
                replies = asked(self._session, key, payload, max(deadline - time.monotonic(), _LEAST_S))
            except zenoh.ZError as error:
                raise TransportError(f"cannot ask {key}: {zenoh_reason(error)}") from error
            if replies is not None:
                return replies
            if time.monotonic() > deadline:
                raise nobody_answers(key, timeout_s)
            time.sleep(_ASK_AGAIN_S)  # nobody is there, or nobody yet

    def hold(self, key: str) -> Closing:
        return self._presence.hold(key)

    def live(self, key: str) -> set[str]:
        return self._presence.live(key)

    def watch(self, key: str, watcher: Watcher) -> Closing:
        return self._presence.watch(key, watcher)

    def settle(self, timeout_s: float, images: bool = False) -> bool:
        return self._presence.settle(timeout_s, images)

    def close(self) -> None:
        self._presence.close()
        for closer in self._mine:
            closer.close()
        self._session.close()

    def _open_presence(self, name: str) -> Presence:
        # Its own words must not come back: while it answers nobody empties its queue, and a full one would block it.
        voice = self._session.declare_publisher(
            f"peers/{name}",
            priority=zenoh.Priority.INTERACTIVE_HIGH,
            congestion_control=_CONGESTION,
            allowed_destination=zenoh.Locality.REMOTE,
        )

        def say(word: bytes) -> None:
            try:
                voice.put(word)
            except zenoh.ZError as error:
                raise TransportError(f"cannot send on the bus: {zenoh_reason(error)}") from error

        presence = Presence(name, say, lambda: map(str, self._session.info.peers_zid()))
        self.subscribe("peers/*", lambda key, payload, _: presence.heard(key.rsplit("/", 1)[1], payload), 256)

        def changed(event: Any) -> None:
            if event.transport.whatami == zenoh.WhatAmI.PEER:
                presence.links_changed()

        events = self._session.info.declare_transport_events_listener(changed, history=True)
        self._mine.append(Closer(events.undeclare))
        return presence

    def _check(self, deed: Deed, key: str) -> None:
        if self._access is not None:
            self._access.check(deed, key)

    def _closer(self, action: Callable[[], None]) -> Closing:
        closer = Closer(action)
        self._mine.append(closer)
        return closer


def feed(channel: Any, sink: Sink) -> None:
    """Give the samples of a subscriber's channel to `sink`, until the channel ends."""
    while True:
        try:
            sample = channel.recv()
        except zenoh.ZError:
            return
        key, payload = str(sample.key_expr), sample.payload.to_bytes()
        del sample
        sink(key, payload, time.time_ns())


def serve_hub(
    listen: str = LOCAL_HUB, settings: Mapping[str, Any] | None = None, stop: threading.Event | None = None,
    access: Access | None = None, others: Sequence[str] = (),
) -> None:  # fmt: skip
    """Be the meeting point of all processes until SIGTERM, SIGINT or `stop`.

    access: as of `ZenohBus`. others: hubs that messages are passed to and from; they may come and go. Raises
    TransportError where it cannot listen, as on a port in use.
    """
    router: dict[str, Any] = {"mode": "router", "listen/endpoints": [checked_endpoint(listen)]}
    if others:
        router |= {"connect/endpoints": [checked_endpoint(other) for other in others], **_PATIENT}
    what = f"no hub at {listen}: is another one running there, or another program? Choose a free port"
    with StopSignals(stop) as signals:
        session = open_session({**router, **closing(access), **(settings or {})}, what)
        try:
            # A signal that the kernel gives to another thread of this process ends no wait that has no end.
            while not signals.stop.wait(_SIGNAL_S):
                pass
        finally:
            session.close()


def open_session(values: Mapping[str, Any], what: str) -> Any:
    """A session of Zenoh with these values in its configuration, by path. Raises TransportError, begun with `what`."""
    common = {
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": True,
        # Opening a session waits this long for peers that the hub still names and that are gone.
        "scouting/delay": 100,
        "transport/link/tx/lease": 2000,
        "transport/link/tx/queue/congestion_control/drop": _WAITS_US,
        **shared_memory.settings(),
    }
    config = zenoh.Config()
    try:
        for path, value in {**common, **values}.items():
            config.insert_json5(path, json.dumps(value))
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise TransportError(f"{what}: {zenoh_reason(error)}") from error


def closing(access: Access | None) -> dict[str, Any]:
    """Settings that keep out who is not of a closed bus; none where it is open."""
    return {} if access is None else access.settings()


def checked_endpoint(text: str) -> str:
    """The address, where it has the form of one. Raises TransportError."""
    if not _ENDPOINT.fullmatch(text):
        raise TransportError(f"{text!r} is no address of a hub; expected for instance {LOCAL_HUB}")
    return text


def zenoh_reason(error: Exception) -> str:
    """Zenoh's message without the places in its source."""
    return re.sub(r" at /\S+", "", str(error)).strip()
