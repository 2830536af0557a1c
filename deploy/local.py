"""The graph in one process and one thread: what a handler says is handed to those that read it, as it is."""

from __future__ import annotations

import copy
import time
from collections import deque
from collections.abc import Container, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import msgspec
import numpy as np

from fieldpose.bus.messages import (
    CameraOrigin,
    Guess,
    Message,
    Pose,
    Prior,
    Reason,
    State,
    TrackingState,
)  # fmt: skip
from fieldpose.bus.node import EndOfInput, Handler, Output, first_header
from fieldpose.bus.topics import PRIOR, Topic
from fieldpose.deploy.graph import CAMERA, HUB, RECORDER, Launch, rows_of
from fieldpose.deploy.parts import Parts
from fieldpose.deploy.plan import resolve
from fieldpose.deploy.settings import Settings
from fieldpose.errors import ConfigError
from fieldpose.stages.camera.wire import frame_messages
from fieldpose.stages.geometry import Camera
from fieldpose.stages.nerf.rendering_api import RayRenderer
from fieldpose.stages.nerf.training_views import TrainingViews


@dataclass(frozen=True)
class Said:
    """A message on its way, who sent it, and how long its sender was at work."""

    topic: Topic[Any]
    message: Message
    sender: str
    ms: float


class LocalPipeline:
    """The handlers of a plan, but for the camera unless asked for, started. Raises what they raise at start.

    only: of these processes alone.
    """

    def __init__(self, parts: Parts, with_camera: bool = False, only: Container[str] | None = None) -> None:
        left_out = {HUB, RECORDER} if with_camera else {HUB, RECORDER, CAMERA}
        rows = [row for row in rows_of(parts.plan, recorded=False) if row.name not in left_out]
        rows = [row for row in rows if only is None or row.name in only]
        self.handlers: list[Handler] = [row.make(parts, Launch()) for row in rows if row.make is not None]
        for handler in self.handlers:
            handler.start()

    def send(self, *outputs: Output) -> Iterator[Said]:
        """Hand these messages on, and give all that is said because of them, until nothing more is."""
        waiting = deque(Said(topic, stamped(message, ""), "", 0.0) for topic, message in outputs)
        while waiting:
            said = waiting.popleft()
            yield said
            for handler in self.handlers:
                if said.topic in handler.inputs:
                    waiting.extend(_timed(handler.name, handler.handle(said.topic, said.message)))

    def play(self) -> Iterator[Said]:
        """Let the camera send its source to the end, and give all that is said."""
        try:
            while True:
                for handler in self.handlers:
                    for topic, message in handler.tick(time.time_ns()):
                        yield from self.send((topic, message))
        except EndOfInput:
            return

    def close(self) -> None:
        """Let go of what the handlers hold."""
        for handler in self.handlers:
            handler.stop()


@dataclass(frozen=True)
class PoseFound:
    """The answer for one image: `reason` says why there is no pose.

    cam_from_object (4, 4) in OpenCV axes; covariance (6, 6) of its left twist (translation, rotation), in the field's
    unit and radians; score in 0..1. stage_ms: the time of each stage, all passes together.
    """

    reason: Reason | None
    cam_from_object: np.ndarray | None = None
    covariance: np.ndarray | None = None
    score: float = 0.0
    state: TrackingState = TrackingState.LOST
    inliers: int = 0
    correspondences: int = 0
    residual_px: float | None = None
    refined: bool = False
    loss_before: float | None = None
    loss_after: float | None = None
    passes: int = 1
    stage_ms: dict[str, float] = field(default_factory=dict)

    @property
    def ok(self) -> bool:
        """Whether a pose was found."""
        return self.cam_from_object is not None


class PoseFinder:
    """Finds the pose of single images: renders, matches, lifts, solves and refines, until a pose is believed.

    Raises FieldFileError, ConfigError and WeightsError.
    """

    def __init__(self, parts: Parts) -> None:
        if parts.plan.begins.by_frame:
            guess = parts.settings.tracking.guess
            raise ConfigError(f"guess {guess}: tells of frames; for an image give train:NAME or a file with one pose")
        self._parts = parts
        self._pipeline = LocalPipeline(parts)
        self._images = 0

    def prepare(self, camera: Camera) -> None:
        """Render all training views for a camera and keep what is needed of them, as far as the settings let it.

        An image that is then found from one of them takes a third of the time.
        """
        from fieldpose.stages.lifting.core import lift
        from fieldpose.stages.lifting.node import view_rng
        from fieldpose.stages.rendering.core import opacity_bytes

        parts = self._parts
        for pose in parts.training_views.cam_from_object:
            sourced = parts.views.view(camera, pose)
            if isinstance(sourced, Reason):
                continue
            view, view_id = sourced.view, sourced.view_id
            opacity = opacity_bytes(view.opacity)
            pixels = parts.pairs.view_features(view.rgb, opacity, view_id).pixels
            lift(
                parts.renderer, view.depth, opacity, view.camera, pose, pixels, view_rng(view_id),
                parts.settings.lifting, parts.consistency.of(view_id),
            )  # fmt: skip

    def find(
        self, image: np.ndarray, camera: Camera, guess: np.ndarray | None = None,
        origin: CameraOrigin = CameraOrigin.CALIBRATED,
    ) -> PoseFound:  # fmt: skip
        """The pose of an image (h, w, 3) uint8 from a guessed cam_from_object (4, 4).

        Without a guess it is found from the training views that look like the image. `origin`: where the camera was
        taken from; one that was assumed makes no pose certain.
        """
        header = first_header(self._images, self._images)
        self._images += 1
        sent: list[Output] = []
        if guess is not None:
            sent.append((PRIOR, Prior(header=header, cam_from_object=np.array(guess, np.float64))))
        sent += frame_messages(header, image, "rgb8", camera, origin)
        return _found(list(self._pipeline.send(*sent)))

    def close(self) -> None:
        """Let go of what the handlers hold."""
        self._pipeline.close()


def photo_finder(settings: Settings, views: TrainingViews, renderer: RayRenderer) -> PoseFinder:
    """A finder for photos, each by itself, in a field that is in memory. Raises ConfigError and WeightsError."""
    photos = replace(settings, tracking=replace(settings.tracking, sequence="photos"))
    return PoseFinder(Parts(resolve(photos, views), renderer=renderer, views=views, together=True))


def stamped(message: Message, source: str) -> Message:
    """With the sender and the time of sending in its header, as a message on the bus has them."""
    stamped = copy.copy(message)
    stamped.header = msgspec.structs.replace(message.header, source=source, sent_ns=time.time_ns())
    return stamped


def _timed(sender: str, outputs: Iterable[Output]) -> Iterator[Said]:
    began = time.perf_counter()
    for topic, message in outputs:
        yield Said(topic, stamped(message, sender), sender, (time.perf_counter() - began) * 1e3)
        began = time.perf_counter()


def _found(said: Sequence[Said]) -> PoseFound:
    messages = [one.message for one in said]
    state = next((message for message in messages if isinstance(message, State)), None)
    if state is None:  # there is nothing to begin with, so that tracking waits for a guess
        return PoseFound(Reason.NO_GUESS, passes=0)
    passes = sum(isinstance(message, Guess) for message in messages)
    stage_ms: dict[str, float] = {}
    for one in said:
        if one.sender:
            stage_ms[one.sender] = stage_ms.get(one.sender, 0.0) + one.ms
    believed = state.cam_from_object
    poses = [message for message in messages if isinstance(message, Pose)]
    if believed is None:
        return PoseFound(state.reason or Reason.IMPLAUSIBLE_POSE, passes=passes, stage_ms=stage_ms)
    pose = next(pose for pose in reversed(poses) if np.array_equal(pose.cam_from_object, believed))
    return PoseFound(
        None, believed, state.covariance, state.score, state.state, pose.inliers, pose.correspondences,
        pose.residual_px, pose.refined, pose.loss_before, pose.loss_after, passes, stage_ms,
    )  # fmt: skip
