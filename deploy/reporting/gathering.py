"""What a pipeline says about each frame, put together: as it comes over a bus, or from a recording."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from fieldpose.bus.messages import CameraInfo, Frame, Header, Message, Reason, State, Truth
from fieldpose.bus.reading import RecordingInfo, info, read_recording
from fieldpose.bus.topics import CAMERA_INFO, FRAME, GUESS, STATE, TRUTH, Address, Topic
from fieldpose.deploy.graph import BETWEEN_STAGES, CAMERA
from fieldpose.deploy.reporting.results import FrameResult, Outcome, TruthKnown
from fieldpose.errors import RecordingError, UsageError
from fieldpose.stages.geometry import Camera, Similarity

TIMED = (FRAME, *BETWEEN_STAGES)
"""Topics of which headers are enough: when something was sent, and by whom."""
FRAMES_KEPT = 100_000
_MOST_SENT = 1024
"""Of one frame: more than any that is searched for in all its passes."""


@dataclass
class _Seen:
    """Everything about one frame; `sent`: when each process has sent something of it; `passes`: its guesses."""

    capture_ns: int
    camera_sent_ns: int | None = None
    sent: list[tuple[int, str]] = field(default_factory=list)
    passes: int = 0
    state: State | None = None
    truth: TruthKnown | None = None
    camera: Camera | None = None


class Gathering:
    """Everything about the frames of one pipeline.

    object_from_dataset: into the frame that poses are in; true ones are in that of the dataset. kept: how many of the
    newest frames, None for all; `forgotten`: how many came before.
    """

    def __init__(self, object_from_dataset: Similarity | None = None, kept: int | None = FRAMES_KEPT) -> None:
        self._object_from_dataset = object_from_dataset or Similarity.identity()
        self._kept = kept
        self.forgotten = 0
        self._frames: OrderedDict[tuple[int, int], _Seen] = OrderedDict()

    def note_header(self, topic: Topic[Any], header: Header) -> None:
        """Take in that a message of TIMED was sent."""
        seen = self._seen(header)
        if topic is FRAME:
            seen.camera_sent_ns = header.sent_ns
        else:
            if len(seen.sent) < _MOST_SENT:
                seen.sent.append((header.sent_ns, header.source))
            seen.passes += topic is GUESS

    def note(self, message: Message) -> None:
        """Take in what a message says of its frame."""
        match message:
            case State():
                self._seen(message.header).state = message
            case Truth():
                self._seen(message.header).truth = TruthKnown(self._in_frame(message.cam_from_object))
            case CameraInfo() | Frame():
                self._seen(message.header).camera = message.camera

    def results(self) -> list[FrameResult]:
        """What became of each frame that the camera has sent, oldest first."""
        return [_result(frame_id, self._frames[at_ns, frame_id]) for at_ns, frame_id in sorted(self._frames)]

    def result(self, header: Header) -> FrameResult:
        """What has become so far of the frame that a message is of."""
        return _result(header.frame_id, self._seen(header))

    def _in_frame(self, pose: np.ndarray | None) -> np.ndarray | None:
        known = _copied(pose)
        return None if known is None else self._object_from_dataset.of_poses(known[None])[0]

    def _seen(self, header: Header) -> _Seen:
        # The capture time tells a camera's frames from those of one that began again.
        key = (header.capture_ns, header.frame_id)
        seen = self._frames.get(key)
        if seen is None:
            seen = self._frames[key] = _Seen(header.capture_ns)
            if self._kept is not None and len(self._frames) > self._kept:
                self._frames.popitem(last=False)
                self.forgotten += 1
        return seen


def recorded_results(
    path: Path, pipeline: str | None = None, object_from_dataset: Similarity | None = None
) -> tuple[Address, list[FrameResult]]:
    """What became of each frame of a recorded pipeline, OBJECT/CAMERA where there are several, and its address.

    object_from_dataset: see Gathering.
    Raises RecordingError for a recording without states, and UsageError where the pipeline is not one of several.
    """
    addresses = _addresses(info(path), (STATE,))
    if not addresses:
        raise RecordingError(f"{path}: holds no poses, since nothing of the topic {STATE.name} was recorded")
    address = _chosen(path, addresses, pipeline)
    gathering = Gathering(object_from_dataset, kept=None)
    for recorded in read_recording(path, (*TIMED, CAMERA_INFO, TRUTH, STATE)):
        if address.covers(recorded.key):
            if recorded.topic in TIMED:
                gathering.note_header(recorded.topic, recorded.message.header)
            gathering.note(recorded.message)
    return address, gathering.results()


def recorded_pipeline(path: Path, pipeline: str | None = None) -> Address:
    """The address of a recorded pipeline, OBJECT/CAMERA where there are several; of a camera, where nothing else is.

    Raises RecordingError for a recording without messages, and UsageError where the pipeline is not one of several.
    """
    recording = info(path)
    for topics in ((STATE,), (TRUTH, *BETWEEN_STAGES), (FRAME, CAMERA_INFO)):
        addresses = _addresses(recording, topics)
        if addresses:
            return _chosen(path, addresses, pipeline)
    raise RecordingError(f"{path}: holds neither frames nor poses; `fieldpose info` lists what it has")


def _addresses(recording: RecordingInfo, topics: Sequence[Topic[Any]]) -> dict[str, Address]:
    """OBJECT/CAMERA -> address, of all that has sent on some topics."""
    found = (topic.address_of(held.key) for topic in topics for held in recording.topics)
    return {address.pair: address for address in found if address is not None}


def _chosen(path: Path, addresses: Mapping[str, Address], pipeline: str | None) -> Address:
    if pipeline not in addresses and (pipeline is not None or len(addresses) > 1):
        raise UsageError(f"{path}: holds the pipelines {', '.join(sorted(addresses))}; choose one with --pipeline")
    return addresses[pipeline or next(iter(addresses))]


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
        camera=seen.camera,
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
