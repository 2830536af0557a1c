"""From a pipeline's messages to what Foxglove shows of them; files and the live bridge share this."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import msgspec
import numpy as np
from foxglove import messages as shown
from foxglove.messages import LogLevel

from fieldpose.bus.messages import (
    CameraInfo,
    Control,
    Correspondences,
    Estimate,
    Failure,
    Followed,
    Frame,
    Guess,
    Header,
    Matches,
    Message,
    Pose,
    Prior,
    State,
    Stats,
    TrackingState,
    Truth,
    View,
)
from fieldpose.bus.topics import Topic
from fieldpose.deploy.foxglove import channels, drawing, figures
from fieldpose.deploy.foxglove.channels import Channel
from fieldpose.deploy.reporting.gathering import TIMED, Gathering
from fieldpose.stages.geometry import Camera, Similarity

_FRAMES_KEPT = 1000
_PATH_POSES, _PATH_NS = 600, 1_000_000_000
_RATE_STATES = 31
_SAME_CLOCK_NS = 60_000_000_000
_COLOURS = {
    TrackingState.TRACKING: drawing.GREEN,
    TrackingState.LIMITED: drawing.ORANGE,
    TrackingState.LOST: drawing.RED,
    TrackingState.INITIALIZING: drawing.GREY,
}
_LEVELS = {
    TrackingState.TRACKING: LogLevel.Info,
    TrackingState.LIMITED: LogLevel.Warning,
    TrackingState.LOST: LogLevel.Error,
    TrackingState.INITIALIZING: LogLevel.Info,
}


class Converted(NamedTuple):
    """A message for a channel: its bytes, when the frame was captured, when it was sent, its sender's number."""

    channel: Channel
    payload: bytes
    log_ns: int
    publish_ns: int
    sequence: int


class Converter:
    """Converts the messages of one pipeline, in the order of their receipt.

    wanted: asked of each message before it is made. object_from_dataset: into the frame that poses are in, for true
    poses, which are in that of the dataset; without it these are left out. behind_ns: see clock_behind_ns, of the first
    frame.
    """

    def __init__(
        self,
        wanted: Callable[[Channel], bool] = lambda channel: True,
        object_from_dataset: Similarity | None = None,
        behind_ns: int = 0,
    ) -> None:
        self._wanted = wanted
        self._object_from_dataset = object_from_dataset
        self._gathering = Gathering(object_from_dataset, _FRAMES_KEPT)
        self._calibrated: deque[tuple[int, int]] = deque(maxlen=_FRAMES_KEPT)
        self._states: deque[int] = deque(maxlen=_RATE_STATES)
        self._path: deque[shown.Pose] = deque(maxlen=_PATH_POSES)
        self._path_ns: int | None = None
        self._believed: tuple[Any, Any] | None = None
        self._lost = 0
        self._behind_ns = behind_ns

    def convert(self, topic: Topic[Any], message: Message) -> Iterator[Converted]:
        """What a message becomes: any number of messages, none where there is nothing to see.

        Raises OutputError for an image that cannot be encoded.
        """
        header = message.header
        if topic in TIMED:
            self._gathering.note_header(topic, header)
        if not isinstance(message, Truth) or self._object_from_dataset is not None:
            self._gathering.note(message)
        at = header.capture_ns
        if isinstance(message, Frame | CameraInfo):
            self._behind_ns = clock_behind_ns(header)
        elif isinstance(message, Stats | Control):
            at = max(at - self._behind_ns, 0)
        for channel, make in self._offers(message, at):
            if self._wanted(channel):
                made = make()
                payload = msgspec.json.encode(made) if isinstance(made, msgspec.Struct) else made.encode()
                yield Converted(channel, payload, at, header.sent_ns, header.sequence)

    def _offers(self, message: Message, at: int) -> Iterator[tuple[Channel, Callable[[], Any]]]:
        match message:
            case Frame():
                yield from self._camera(message.header, message.camera)
                yield channels.IMAGE, lambda: drawing.image(message.image, message.encoding, drawing.CAMERA, at)
            case CameraInfo():
                yield from self._camera(message.header, message.camera)
            case Truth():
                yield from self._truth(message)
            case Prior():
                yield channels.PRIOR, lambda: drawing.pose_in_object(message.cam_from_object, at)
            case Guess():
                yield channels.TRANSFORMS, lambda: drawing.transform(message.cam_from_object, drawing.GUESS, at)
                yield channels.GUESS, lambda: drawing.pose_in_object(message.cam_from_object, at)
                yield channels.GUESS_CALIBRATION, lambda: drawing.calibration(message.camera, drawing.GUESS, at)
            case View():
                yield channels.TRANSFORMS, lambda: drawing.transform(message.cam_from_object, drawing.VIEW, at)
                yield channels.VIEW_CALIBRATION, lambda: drawing.calibration(message.camera, drawing.VIEW, at)
                yield channels.VIEW_IMAGE, lambda: drawing.image(message.rgb, "rgb8", drawing.VIEW, at)
                yield channels.VIEW_DEPTH, lambda: drawing.depth(message.depth, drawing.VIEW, at)
            case Matches():
                yield channels.MATCHES, lambda: drawing.marked([_matched(message.pixels_in_frame)], at)
                yield channels.VIEW_MATCHES, lambda: drawing.marked([_matched(message.pixels_in_view)], at)
            case Correspondences():
                groups = _two_groups(message.pixels_in_frame, message.kept, ("kept", "discarded"), drawing.RED)
                yield channels.CORRESPONDENCES, lambda: drawing.marked(groups, at)
                yield channels.POINTS, lambda: drawing.cloud(message, at)
            case Estimate():
                inliers = ("inlier", message.inliers_in_frame, drawing.GREEN)
                yield channels.INLIERS, lambda: drawing.marked([inliers], at)
            case Pose():
                yield channels.SOLVED_FIGURES, lambda: figures.of_pose(message)
            case Followed():
                sought = _two_groups(message.pixels_in_frame, message.found, ("found", "not found"), drawing.ORANGE)
                yield channels.FOLLOWED, lambda: drawing.marked(sought, at)
                yield channels.FOLLOWED_FIGURES, lambda: figures.of_followed(message)
            case State():
                yield from self._state(message)
            case Failure():
                text = f"{message.stage}: {message.reason} (frame {message.header.frame_id}, {_pass(message.header)})"
                yield channels.LOG, lambda: drawing.log(text, LogLevel.Warning, message.stage, at)
            case Control():
                asked = f"asked for: {message.request}, after frame {message.after_frame}"
                yield channels.LOG, lambda: drawing.log(asked, LogLevel.Info, "control", at)
            case Stats():
                yield channels.STATS, lambda: figures.of_stats(message)

    def _camera(self, header: Header, camera: Camera) -> Iterator[tuple[Channel, Callable[[], Any]]]:
        """One calibration a frame, which is told twice, with its pixels and without."""
        if header.frame_key not in self._calibrated:
            self._calibrated.append(header.frame_key)
            at = header.capture_ns
            yield channels.CALIBRATION, lambda: drawing.calibration(camera, drawing.CAMERA, at)

    def _truth(self, truth: Truth) -> Iterator[tuple[Channel, Callable[[], Any]]]:
        if truth.cam_from_object is not None and self._object_from_dataset is not None:
            at, pose = truth.header.capture_ns, self._object_from_dataset.of_poses(truth.cam_from_object[None])[0]
            yield channels.TRANSFORMS, lambda: drawing.transform(pose, drawing.TRUTH, at)
            yield channels.TRUTH, lambda: drawing.pose_in_object(pose, at)

    def _state(self, state: State) -> Iterator[tuple[Channel, Callable[[], Any]]]:
        at, pose, sure = state.header.capture_ns, state.cam_from_object, state.is_sure
        yield from self._news(state)
        if pose is not None:
            channel, frame = (channels.POSE, drawing.CAMERA) if sure else (channels.UNSURE, drawing.UNSURE)
            yield channels.TRANSFORMS, lambda: drawing.transform(pose, frame, at)
            yield channel, lambda: drawing.pose_in_object(pose, at)
            if sure:
                self._path.append(drawing.pose(pose))
                # A clock that went back, or a source that began again, starts the second anew.
                if self._path_ns is None or not 0 <= at - self._path_ns < _PATH_NS:
                    self._path_ns = at
                    yield channels.PATH, lambda: drawing.path_in_object(self._path, at)
        self._states.append(state.header.sent_ns)
        text = f"{state.state} {state.score:.2f}" if state.reason is None else f"{state.state}: {state.reason}"
        yield channels.CAPTION, lambda: drawing.caption(text, _COLOURS[state.state], at)
        result = self._gathering.result(state.header)
        yield channels.STATE, lambda: figures.of_state(state, result, sure, self._rate_hz())

    def _news(self, state: State) -> Iterator[tuple[Channel, Callable[[], Any]]]:
        """A line where tracking's state or its reason is another than before, and where frames were given up."""
        at, frame = state.header.capture_ns, state.header.frame_id
        if (state.state, state.reason) != self._believed:
            why = "" if state.reason is None else f": {state.reason}"
            text = f"{state.state}{why} (frame {frame}, score {state.score:.2f})"
            yield channels.LOG, lambda: drawing.log(text, _LEVELS[state.state], "tracking", at)
        if state.lost > self._lost:
            given_up = f"{state.lost - self._lost} frames given up, since no answer came (at frame {frame})"
            yield channels.LOG, lambda: drawing.log(given_up, LogLevel.Error, "tracking", at)
        self._believed, self._lost = (state.state, state.reason), state.lost

    def _rate_hz(self) -> float | None:
        span_s = (self._states[-1] - self._states[0]) / 1e9
        return (len(self._states) - 1) / span_s if span_s > 0 else None


def clock_behind_ns(header: Header) -> int:
    """How far a frame's clock is behind this computer's, where it is another: a simulation's, or that of a ROS bag.

    What is of no frame has this computer's time, and is to be beside the frames.
    """
    behind_ns = header.sent_ns - header.capture_ns
    return behind_ns if abs(behind_ns) > _SAME_CLOCK_NS else 0


def _matched(pixels: np.ndarray) -> tuple[str, np.ndarray, drawing.Colour]:
    return "matched", pixels, drawing.BLUE


def _two_groups(
    pixels: np.ndarray, good: np.ndarray, names: tuple[str, str], bad: drawing.Colour
) -> list[tuple[str, np.ndarray, drawing.Colour]]:
    return [(names[0], pixels[good], drawing.GREEN), (names[1], pixels[~good], bad)]


def _pass(header: Header) -> str:
    return f"pass {header.pass_index}"
