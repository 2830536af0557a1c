"""Feeding a recorded topic to the stages after it, one message at a time, in this process."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from fieldpose.bus.messages import Failure, Message
from fieldpose.bus.reading import read_recording
from fieldpose.bus.topics import BY_NAME, FAILURE, FRAME, STATE, Address, Topic
from fieldpose.deploy.graph import AT_WORK, GRAPH, Process
from fieldpose.deploy.local import LocalPipeline, Said
from fieldpose.deploy.parts import Parts
from fieldpose.deploy.plan import Plan
from fieldpose.deploy.replaying.comparison import Comparison
from fieldpose.errors import RecordingError

CAMERA = "camera"
Beginning = Literal["camera", "search", "guess", "view", "matches", "correspondences", "estimate"]
"""Where to begin: at the camera's frames, with tracking, or at what one of the stages reads, without it."""


@dataclass(frozen=True)
class Played:
    """A recorded message that was fed, and all that the stages have said because of it."""

    topic: Topic[Any]
    message: Message
    said: Sequence[Said]


def rows_after(beginning: Beginning, plan: Plan) -> list[Process]:
    """The processes with something to do because of it: each that is driven, by the first that it reads, by another."""
    rows = [row for row in GRAPH if row.name in AT_WORK and row.wanted(plan)]
    if beginning == CAMERA:
        return rows
    found: list[Process] = []
    said = {BY_NAME[beginning]}
    for row in rows:
        if row.reads[0] in said:
            found.append(row)
            said |= set(row.writes) - {FAILURE}
    return found


class Feeding:
    """The stages after a beginning, started, and a recording to feed them from. Raises what they raise at start.

    fed: how many of the messages have been fed that each are to be answered, by a result or a failure; answered: how
    many were. comparison: of all that was said with what is recorded.
    """

    def __init__(self, path: Path, address: Address, beginning: Beginning, parts: Parts) -> None:
        self.fed = self.answered = 0
        self.comparison = Comparison()
        self._path, self._address = path, address
        self._driver: Topic[Any] = FRAME if beginning == CAMERA else BY_NAME[beginning]
        rows = rows_after(beginning, parts.plan)
        self._names = {row.name for row in rows}
        self._pipeline = LocalPipeline(parts, only=[row.name for row in rows])
        self._says = {topic for row in rows for topic in row.writes}
        self._reads = {topic for handler in self._pipeline.handlers for topic in handler.inputs} - self._says
        read = {topic for row in rows for topic in row.reads}
        self._results = {STATE} if beginning == CAMERA else {FAILURE, *(self._says - read)}

    def play(self, first_ns: int = 0) -> Iterator[Played]:
        """Feed what was captured from `first_ns` on, in the recorded order. Raises RecordingError."""
        wanted = self._frames(first_ns)
        if not wanted:
            since = " from that time on" if first_ns else ""
            raise RecordingError(
                f"{self._path}: has no {self._driver.name} of {self._address.pair}{since} to begin with"
            )
        for recorded in read_recording(self._path, self._reads | self._says):
            topic, message = recorded.topic, recorded.message
            if not self._address.covers(recorded.key) or message.header.frame_key not in wanted:
                continue
            if topic in self._says:
                if not isinstance(message, Failure) or message.stage in self._names:
                    self.comparison.recorded(topic, message)
            else:
                yield Played(topic, message, self._feed(topic, message))

    def close(self) -> None:
        """Let go of what the stages hold."""
        self._pipeline.close()

    def _feed(self, topic: Topic[Any], message: Message) -> list[Said]:
        said = [one for one in self._pipeline.send((topic, message)) if one.sender]
        self.fed += topic is self._driver
        self.answered += sum(one.topic in self._results for one in said)
        for one in said:
            self.comparison.replayed(one.topic, one.message)
        return said

    def _frames(self, first_ns: int) -> set[tuple[int, int]]:
        driving = (recorded for recorded in read_recording(self._path, (self._driver,)))
        headers = (recorded.message.header for recorded in driving if self._address.covers(recorded.key))
        return {header.frame_key for header in headers if header.capture_ns >= first_ns}


def starting_ns(path: Path, address: Address, start_s: float) -> int:
    """The capture time so many seconds after that of the first camera frame; 0 for none. Raises RecordingError."""
    if start_s == 0:
        return 0
    return min((time_ns for time_ns in _captured(path, address)), default=0) + round(start_s * 1e9)


def frames_before(path: Path, address: Address, first_ns: int) -> int:
    """How many camera frames are older. Raises RecordingError."""
    return sum(time_ns < first_ns for time_ns in _captured(path, address)) if first_ns else 0


def compared(recorded: Path, replayed: Path, address: Address, first_ns: int = 0) -> Comparison:
    """What the processes of a pipeline said, in two recordings of it, from a capture time of the first on.

    Raises RecordingError.
    """
    comparison = Comparison()
    topics = [topic for row in GRAPH if row.name in AT_WORK for topic in row.writes]
    for one in read_recording(recorded, topics):
        if address.covers(one.key) and one.message.header.capture_ns >= first_ns:
            comparison.recorded(one.topic, one.message)
    for one in read_recording(replayed, topics):
        comparison.replayed(one.topic, one.message)
    return comparison


def _captured(path: Path, address: Address) -> list[int]:
    times = [one.message.header.capture_ns for one in read_recording(path, (FRAME,)) if address.covers(one.key)]
    if not times:
        raise RecordingError(f"{path}: has no camera frames of {address.pair}")
    return times
