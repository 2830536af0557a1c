"""A stranger on the bus of a pipeline, who attacks it for some seconds once it tracks; says what he has sent."""

from __future__ import annotations

import faulthandler
import json
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator

import msgspec
import numpy as np
from support.bus_samples import every_message

from fieldpose.bus import topics
from fieldpose.bus.codec import encode
from fieldpose.bus.messages import Header, State, TrackingState
from fieldpose.bus.topics import Address, Topic
from fieldpose.bus.transport import ZenohBus
from fieldpose.stages.geometry import exp_se3

Sent = Iterator[tuple[Topic, bytes]]
ADDRESS = Address()
LONGEST_S = 150
FAR_NS = 3600 * 10**9
SAMPLES = every_message()


class Stranger:
    """Hears what the pipeline says, and answers with lies."""

    def __init__(self, bus: ZenohBus) -> None:
        self.bus = bus
        self.newest = Header("x", 0, 0, 0, time.time_ns(), 0)
        self.pose = np.eye(4)
        self.tracked = threading.Event()
        bus.subscribe(ADDRESS.key(topics.STATE), self.heard, 64)

    def heard(self, key: str, payload: bytes, received_ns: int) -> None:
        try:
            state = msgspec.msgpack.decode(payload)
            header = msgspec.convert(state["header"], Header)
        except (msgspec.MsgspecError, ValueError, TypeError, KeyError):
            return
        if header.source != "tracking" or header.instance == 0:
            return  # his own
        self.newest = header
        if state["cam_from_object"] is not None:
            self.tracked.set()
            self.pose = np.frombuffer(state["cam_from_object"]["data"]).reshape(4, 4)

    def lie(self, topic: Topic, number: int, source: str = "", ahead_ns: int = 0, instance: int = 0) -> bytes:
        """A right message of the newest frame, whose pose has drifted."""
        message = SAMPLES[topic]
        newest = self.newest
        source = source or next(iter(topic.writers), "pnp")
        message.header = Header(
            source, number, newest.frame_id, 0, max(0, newest.capture_ns + ahead_ns), time.time_ns(), instance
        )
        if np.shape(getattr(message, "cam_from_object", None)) == (4, 4):
            drift = exp_se3(np.array([0.002 * (number % 500), 0, 0, 0, 0.002 * (number % 500), 0]))
            message.cam_from_object = drift @ self.pose  # type: ignore[attr-defined]
        if isinstance(message, State):
            message.state, message.score = TrackingState.TRACKING, 1.0
        return encode(message)

    def attacks(self) -> dict[str, Callable[[int], Sent]]:
        every = [topic for topic in topics.ALL if topic not in (topics.FRAME, topics.VIEW)]

        def poses(n: int) -> Sent:
            yield from ((topic, self.lie(topic, n)) for topic in (topics.POSE, topics.STATE, topics.FAILURE))

        def new_sources(n: int) -> Sent:
            yield topics.POSE, self.lie(topics.POSE, 0, f"s{n}")
            yield topics.STATE, self.lie(topics.STATE, 0, f"s{n}", instance=n + 1)

        def numbers(n: int) -> Sent:
            for topic in every:
                yield topic, self.lie(topic, 2**63 - 1 - n)
                yield topic, self.lie(topic, 17_000_000 + n, instance=self.newest.instance)

        def times(n: int) -> Sent:
            for topic in (*every, topics.FRAME):
                yield topic, self.lie(topic, n, ahead_ns=FAR_NS if n % 2 else -FAR_NS)

        def bytes_(n: int) -> Sent:
            for topic in topics.ALL:
                whole = self.lie(topic, n)
                yield topic, whole[: n % len(whole)]
                yield topic, whole.replace(b"sequence", b"sequenze")
                yield topic, np.random.default_rng(n).bytes(64)
                yield topic, self.lie(topics.POSE if topic is not topics.POSE else topics.STATE, n)
            yield topics.GUESS, bytes(5 << 20)

        def everything(n: int) -> Sent:
            yield from ((topic, self.lie(topic, n)) for topic in topics.ALL)

        return {
            "poses": poses, "new sources": new_sources, "numbers": numbers, "times": times, "bytes": bytes_,
            "everything": everything,
        }  # fmt: skip


def main(hub: str, seconds: float) -> None:
    faulthandler.dump_traceback_later(LONGEST_S, exit=True)
    bus = ZenohBus(hub)
    bus.wait_for_hub(120.0)
    stranger, sent = Stranger(bus), Counter[str]()
    bus.settle(2.0)
    stranger.tracked.wait(120.0)
    attacks = stranger.attacks()
    for name, attack in attacks.items():
        end, n = time.monotonic() + seconds / (len(attacks) + 1), 0
        while n == 0 or time.monotonic() < end:
            for topic, payload in attack(n):
                if n > 0 and time.monotonic() > end:
                    break
                bus.put(ADDRESS.key(topic, "pnp"), payload, topic)
                sent[name] += 1
            n += 1
    end = time.monotonic() + seconds / (len(attacks) + 1)
    while not sent["greetings"] or time.monotonic() < end:
        sent["greetings"] += 1
        word = b'{"held":["fieldpose/live/object/camera0/pnp"],"changes":%d,"number":%d,"to":""}'
        bus.put(f"peers/stranger{sent['greetings'] % 999}", word % (2**60, sent["greetings"]))
    bus.close()
    print(json.dumps({"ended_ns": time.time_ns(), "sent": sent}), flush=True)


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]))
