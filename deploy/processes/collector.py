"""What a run's processes say over the bus, gathered frame by frame."""

from __future__ import annotations

from collections import deque
from functools import partial
from typing import Any

from cachetools import LRUCache

from fieldpose.bus.codec import decode_header
from fieldpose.bus.messages import Header, Message, State, Stats
from fieldpose.bus.ports import Inbox, Sequences
from fieldpose.bus.protocol import Bus
from fieldpose.bus.senders import KEPT, Senders
from fieldpose.bus.topics import CAMERA_INFO, FRAME, STATE, STATS, TRUTH, Address, Topic
from fieldpose.deploy.reporting.gathering import TIMED, Gathering
from fieldpose.deploy.reporting.results import FrameResult
from fieldpose.errors import CodecError
from fieldpose.stages.geometry import Similarity

_READ = (STATE, TRUTH, STATS, CAMERA_INFO)
_CAPACITY = 4096
_STAGES_KEPT = 256
_HEADERS_KEPT = 1 << 16
_RATE_WINDOW_NS = 3_000_000_000


class Collector:
    """Listens to one pipeline; images are counted and timed by their headers, never decoded.

    object_from_dataset: see Gathering.
    """

    def __init__(self, bus: Bus, address: Address, object_from_dataset: Similarity | None = None) -> None:
        self.stats: LRUCache[str, Stats] = LRUCache(_STAGES_KEPT)
        self.newest_state: State | None = None
        self.observed: LRUCache[str, int] = LRUCache(KEPT)
        self.sent = 0
        self._numbers = Sequences(from_start=True)
        self._gathering = Gathering(object_from_dataset)
        self._senders = Senders(bus, address.site)
        self._headers: deque[tuple[Topic[Any], Header]] = deque(maxlen=_HEADERS_KEPT)
        self._reported_ns: deque[int] = deque(maxlen=_HEADERS_KEPT)
        self._inbox = Inbox(bus, address, _READ, dict.fromkeys(_READ, _CAPACITY))
        self._subscriptions = [
            bus.subscribe(address.key(topic), partial(self._timed, topic), _CAPACITY) for topic in TIMED
        ]

    def close(self) -> None:
        for subscription in self._subscriptions:
            subscription.close()
        self._inbox.close()
        self._senders.close()

    def update(self) -> None:
        """Take in what has come since the last time."""
        while self._headers:
            self._gathering.note_header(*self._headers.popleft())
        for received in self._inbox.drain():
            self._observe(received.key)
            if not isinstance(received.message, Stats) or received.key.endswith(f"/{received.message.stage}"):
                self._note(received.message)

    def results(self) -> list[FrameResult]:
        """What became of each frame that the camera has sent, oldest first."""
        return self._gathering.results()

    def rate_hz(self, now_ns: int) -> float:
        """Frames that tracking has reported on in the last seconds."""
        while self._reported_ns and self._reported_ns[0] < now_ns - _RATE_WINDOW_NS:
            self._reported_ns.popleft()
        return len(self._reported_ns) / (_RATE_WINDOW_NS / 1e9)

    @property
    def forgotten(self) -> int:
        """Frames that came before those in `results`, of which nothing is known any more."""
        return self._gathering.forgotten

    def _observe(self, key: str) -> None:
        self.observed[key] = self.observed.get(key, 0) + 1

    def _timed(self, topic: Topic[Any], key: str, payload: bytes, received_ns: int) -> None:
        try:
            header = decode_header(payload)
        except CodecError:
            return  # the stages refuse and count it
        if self._senders.doubt(topic, key, header) is not None:
            return
        self._observe(key)
        if topic is FRAME:
            # By the camera's own numbers: where this process is kept from running, it may miss some.
            self.sent += 1 + self._numbers.seen(key, header)
        self._headers.append((topic, header))

    def _note(self, message: Message) -> None:
        if isinstance(message, Stats):
            self.stats[message.stage] = message
            return
        self._gathering.note(message)
        if isinstance(message, State):
            self.newest_state = message
            self._reported_ns.append(message.header.sent_ns)
