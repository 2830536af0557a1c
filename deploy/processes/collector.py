"""What a run's processes say over the bus, gathered frame by frame."""

from __future__ import annotations

from collections import Counter, OrderedDict, deque
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from fieldpose.bus.codec import decode_header
from fieldpose.bus.messages import Header, Message, Reason, State, Stats, Truth
from fieldpose.bus.ports import Inbox, Sequences
from fieldpose.bus.protocol import Bus
from fieldpose.bus.topics import FRAME, GUESS, STATE, STATS, TRUTH, Address, Topic
from fieldpose.deploy.graph import BETWEEN_STAGES, CAMERA
from fieldpose.deploy.reporting.results import FrameResult, Outcome, TruthKnown
from fieldpose.errors import CodecError
from fieldpose.stages.geometry import Similarity

_TIMED = (FRAME, *BETWEEN_STAGES)
_READ = (STATE, TRUTH, STATS)
_CAPACITY = 4096
_FRAMES_KEPT = 100_000
_RATE_WINDOW_NS = 3_000_000_000


@dataclass
class _Seen:
    """Everything about one frame; `sent`: when each process has sent something of it; `passes`: its guesses."""

    capture_ns: int
    camera_sent_ns: int | None = None
    sent: list[tuple[int, str]] = field(default_factory=list)
    passes: int = 0
    state: State | None = None
    truth: TruthKnown | None = None


class Collector:
    """Listens to one pipeline; images are counted and timed by their headers, never decoded.

    The newest 100,000 frames are kept. object_from_dataset: into the frame that poses are in; true ones are in that of
    the dataset.
    """

    def __init__(self, bus: Bus, address: Address, object_from_dataset: Similarity | None = None) -> None:
        self._object_from_dataset = object_from_dataset or Similarity.identity()
        self.stats: dict[str, Stats] = {}
        self.newest_state: State | None = None
        self.observed: Counter[str] = Counter()
        self.sent = 0
        self._numbers = Sequences(from_start=True)
        self._frames: OrderedDict[tuple[int, int], _Seen] = OrderedDict()
        self._headers: deque[tuple[Topic[Any], Header]] = deque()
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
            self._note(received.message)

    def results(self) -> list[FrameResult]:
        """What became of each frame that the camera has sent, oldest first."""
        return [_result(frame_id, self._frames[at_ns, frame_id]) for at_ns, frame_id in sorted(self._frames)]

    def rate_hz(self, now_ns: int) -> float:
        """Frames that tracking has reported on in the last seconds."""
        while self._reported_ns and self._reported_ns[0] < now_ns - _RATE_WINDOW_NS:
            self._reported_ns.popleft()
        return len(self._reported_ns) / (_RATE_WINDOW_NS / 1e9)

    def _timed(self, topic: Topic[Any], key: str, payload: bytes, received_ns: int) -> None:
        try:
            header = decode_header(payload)
        except CodecError:
            return  # the stages refuse and count it
        self.observed[key] += 1
        if topic is FRAME:
            # By the camera's own numbers: where this process is kept from running, it may miss some.
            self.sent += 1 + self._numbers.seen(key, header)
        self._headers.append((topic, header))

    def _note_header(self, topic: Topic[Any], header: Header) -> None:
        seen = self._seen(header)
        if topic is FRAME:
            seen.camera_sent_ns = header.sent_ns
        else:
            seen.sent.append((header.sent_ns, header.source))
            seen.passes += topic is GUESS

    def _note(self, message: Message) -> None:
        match message:
            case Stats():
                self.stats[message.stage] = message
            case State():
                self.newest_state = self._seen(message.header).state = message
                self._reported_ns.append(message.header.sent_ns)
            case Truth():
                self._seen(message.header).truth = TruthKnown(self._in_frame(message.cam_from_object))

    def _in_frame(self, pose: np.ndarray | None) -> np.ndarray | None:
        known = _copied(pose)
        return None if known is None else self._object_from_dataset.of_poses(known[None])[0]

    def _seen(self, header: Header) -> _Seen:
        # The capture time tells a camera's frames from those of one that began again.
        key = (header.capture_ns, header.frame_id)
        seen = self._frames.get(key)
        if seen is None:
            seen = self._frames[key] = _Seen(header.capture_ns)
            if len(self._frames) > _FRAMES_KEPT:
                self._frames.popitem(last=False)
        return seen


def _result(frame_id: int, seen: _Seen) -> FrameResult:
    state = seen.state
    # A score of 0 is no measurement, whatever pose tracking carries on with.
    found = state.cam_from_object if state is not None and state.score > 0 else None
    return FrameResult(
        frame_id=frame_id,
        capture_ns=seen.capture_ns,
        outcome=_outcome(seen),
        passes=seen.passes,
        state=str(state.state) if state is not None else None,
        score=state.score if state is not None else 0.0,
        level=None if state is None else state.level,
        reason=str(state.reason) if state is not None and state.reason is not None else None,
        camera_origin=str(state.camera_origin) if state is not None else None,
        cam_from_object=_copied(found),
        carried=_copied(state.cam_from_object) if state is not None and found is None else None,
        covariance=None if found is None or state is None else _copied(state.covariance),
        truth=seen.truth,
        sent_ns=seen.camera_sent_ns,
        answered_ns=None if state is None else state.header.sent_ns,
        stage_ms=_stage_ms(seen),
    )


def _outcome(seen: _Seen) -> Outcome:
    """What has a state is finished, whether or not any stage has worked on it."""
    if seen.state is None:
        return "lost" if seen.sent else "dropped"
    return "lost" if seen.state.reason in (Reason.NO_ANSWER, Reason.RESET) else "finished"


def _stage_ms(seen: _Seen) -> dict[str, float]:
    """How long each process took for the frame, all passes together: from what was sent before to its own sending.

    A state may come before the stages are done with the frame; none of them has then waited for it.
    """
    sent = sorted(seen.sent)
    if seen.camera_sent_ns is not None:
        sent.insert(0, (seen.camera_sent_ns, CAMERA))
    total: dict[str, float] = {}
    for (before, _), (now, source) in pairwise(sent):
        total[source] = total.get(source, 0.0) + (now - before) / 1e6
    if seen.state is not None:
        now, source = seen.state.header.sent_ns, seen.state.header.source
        before = max((at for at, _ in sent if at <= now), default=now)
        total[source] = total.get(source, 0.0) + (now - before) / 1e6
    return total


def _copied(array: np.ndarray | None) -> np.ndarray | None:
    return None if array is None else np.array(array)
