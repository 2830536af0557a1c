"""What a run's processes say over the bus, gathered frame by frame."""

from __future__ import annotations

from collections import Counter, OrderedDict, deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from fieldpose.bus import topics
from fieldpose.bus.codec import decode_header
from fieldpose.bus.errors import CodecError
from fieldpose.bus.messages import Header, Message, Pose, State, Stats, Truth
from fieldpose.bus.ports import Inbox, Sequences
from fieldpose.bus.protocol import Bus
from fieldpose.bus.topics import FRAME, GUESS, POSE, STATE, STATS, TRUTH, Address, Topic
from fieldpose.deploy.reporting.results import STAGE_OF, FrameResult, Outcome, TruthKnown

_TIMED = (FRAME, GUESS, topics.VIEW, topics.MATCHES, topics.CORRESPONDENCES, topics.ESTIMATE)
_READ = (POSE, STATE, TRUTH, STATS)
_CAPACITY = 4096
_FRAMES_KEPT = 100_000
_RATE_WINDOW_NS = 3_000_000_000


@dataclass
class _Seen:
    """Everything about one frame; `sent_ns` by pass and topic."""

    capture_ns: int
    camera_sent_ns: int | None = None
    sent_ns: dict[int, dict[str, int]] = field(default_factory=dict)
    state: State | None = None
    truth: Truth | None = None


class Collector:
    """Listens to one pipeline; images are counted and timed by their headers, never decoded.

    The newest 100,000 frames are kept.
    """

    def __init__(self, bus: Bus, address: Address) -> None:
        self.stats: dict[str, Stats] = {}
        self.newest_state: State | None = None
        self.observed: Counter[str] = Counter()
        self.sent = 0
        self._numbers = Sequences(from_start=True)
        self._frames: OrderedDict[int, _Seen] = OrderedDict()
        self._headers: deque[tuple[Topic, Header]] = deque()
        self._reported_ns: deque[int] = deque()
        self._inbox = Inbox(bus, address, _READ, dict.fromkeys(_READ, _CAPACITY))
        self._subscriptions = [
            bus.subscribe(address.key(topic), partial(self._timed, topic), _CAPACITY) for topic in _TIMED
        ]

    def close(self) -> None:
        for subscription in self._subscriptions:
            subscription.close()
        self._inbox.close()

    def update(self) -> None:
        """Take in what has come since the last time."""
        while self._headers:
            self._note_header(*self._headers.popleft())
        for received in self._inbox.drain():
            self.observed[received.key] += 1
            self._note(received.topic, received.message)

    def results(self) -> list[FrameResult]:
        """What became of each frame that the camera has sent, oldest first."""
        return [_result(frame_id, seen) for frame_id, seen in sorted(self._frames.items())]

    def rate_hz(self, now_ns: int) -> float:
        """Frames that tracking has reported on in the last seconds."""
        while self._reported_ns and self._reported_ns[0] < now_ns - _RATE_WINDOW_NS:
            self._reported_ns.popleft()
        return len(self._reported_ns) / (_RATE_WINDOW_NS / 1e9)

    def _timed(self, topic: Topic, key: str, payload: bytes, received_ns: int) -> None:
        try:
            header = decode_header(payload)
        except CodecError:
            return  # the stages refuse and count it
        self.observed[key] += 1
        if topic is FRAME:
            # By the camera's own numbers: where this process is kept from running, it may miss some.
            self.sent += 1 + self._numbers.seen(key, header)
        self._headers.append((topic, header))

    def _note_header(self, topic: Topic, header: Header) -> None:
        seen = self._seen(header)
        if topic is FRAME:
            seen.camera_sent_ns = header.sent_ns
        else:
            seen.sent_ns.setdefault(header.pass_index, {})[topic.name] = header.sent_ns

    def _note(self, topic: Topic, message: Message) -> None:
        match message:
            case Stats():
                self.stats[message.stage] = message
            case State():
                self.newest_state = self._seen(message.header).state = message
                self._reported_ns.append(message.header.sent_ns)
            case Truth():
                self._seen(message.header).truth = message
            case Pose():
                self._note_header(topic, message.header)

    def _seen(self, header: Header) -> _Seen:
        seen = self._frames.get(header.frame_id)
        if seen is None:
            seen = self._frames[header.frame_id] = _Seen(header.capture_ns)
            if len(self._frames) > _FRAMES_KEPT:
                self._frames.popitem(last=False)
        return seen


def _result(frame_id: int, seen: _Seen) -> FrameResult:
    state = seen.state
    last = state.header.pass_index if state is not None else max(seen.sent_ns, default=0)
    answered_ns = seen.sent_ns.get(last, {}).get(POSE.name)
    # A score of 0 is no measurement, whatever pose tracking carries on with.
    found = state.cam_from_object if state is not None and state.score > 0 and answered_ns else None
    return FrameResult(
        frame_id=frame_id,
        capture_ns=seen.capture_ns,
        outcome=_outcome(seen, answered_ns),
        passes=len(seen.sent_ns),
        state=str(state.state) if state is not None else None,
        score=state.score if state is not None else 0.0,
        cam_from_object=_copied(found),
        covariance=None if found is None or state is None else _copied(state.covariance),
        truth=None if seen.truth is None else TruthKnown(_copied(seen.truth.cam_from_object)),
        sent_ns=seen.camera_sent_ns,
        answered_ns=answered_ns,
        stage_ms=dict(_stage_ms(seen)),
    )


def _outcome(seen: _Seen, answered_ns: int | None) -> Outcome:
    if not any(GUESS.name in sent for sent in seen.sent_ns.values()):
        return "dropped"
    return "finished" if seen.state is not None and answered_ns is not None else "lost"


def _stage_ms(seen: _Seen) -> Iterator[tuple[str, float]]:
    """How long a stage took for the frame, all passes together: from the sending of its input to its own."""
    total: dict[str, float] = {}
    before = seen.camera_sent_ns
    for _, sent in sorted(seen.sent_ns.items()):
        for topic in STAGE_OF:
            now = sent.get(topic)
            if before is not None and now is not None:
                total[STAGE_OF[topic]] = total.get(STAGE_OF[topic], 0.0) + (now - before) / 1e6
            before = now
    yield from total.items()


def _copied(array: np.ndarray | None) -> np.ndarray | None:
    return None if array is None else np.array(array)
