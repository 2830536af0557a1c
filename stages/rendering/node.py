"""Rendering as a process: guesses in, views out."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path
from typing import cast

import numpy as np

from fieldpose.bus.messages import Guess, GuessReason, Header, Message, Reason, View
from fieldpose.bus.node import JoinedHandler, Output, reply_header
from fieldpose.bus.topics import GUESS, VIEW, Topic
from fieldpose.stages.nerf.loading import load_renderer, warm_up
from fieldpose.stages.rendering.config import RenderingConfig
from fieldpose.stages.rendering.core import ViewSource
from fieldpose.stages.wire import NO_CAMERA, camera_model, camera_of


class RenderingNode(JoinedHandler):
    """Answers each guess with the view there. Raises FieldFileError at start."""

    name = "rendering"
    inputs: tuple[Topic, ...] = (GUESS,)
    outputs: tuple[Topic, ...] = (VIEW,)

    def __init__(self, field: Path, config: RenderingConfig, threads: int = 1) -> None:
        super().__init__()
        self._field, self._config, self._threads = field, config, threads

    def start(self) -> None:
        renderer = load_renderer(self._field, self._threads)
        warm_up(renderer)
        field_id = hashlib.sha256(self._field.read_bytes()).hexdigest()
        self._views = ViewSource(renderer, self._config, field_id)

    def process(self, joined: dict[Topic, Message]) -> Iterable[Output]:
        guess = cast(Guess, joined[GUESS])
        next_pass = guess.reason is GuessReason.NEXT_PASS
        sourced = self._views.view(camera_of(guess.camera), np.array(guess.cam_from_object), next_pass)
        view, ok = sourced.view, sourced.visible >= self._config.min_visible
        yield VIEW, View(
            header=reply_header(guess.header),
            ok=ok,
            reason=Reason.OK if ok else Reason.NOTHING_IN_VIEW,
            view_id=sourced.view_id,
            cam_from_object=view.cam_from_object,
            camera=camera_model(view.camera),
            rgb=view.rgb,
            depth=view.depth,
            opacity=np.rint(view.opacity * 255).astype(np.uint8),
        )  # fmt: skip

    def failure(self, header: Header, reason: Reason) -> Iterable[Output]:
        depth, opacity = np.zeros((0, 0), np.float32), np.zeros((0, 0), np.uint8)
        yield VIEW, View(
            header=reply_header(header), ok=False, reason=reason, view_id="", cam_from_object=np.eye(4),
            camera=NO_CAMERA, rgb=np.zeros((0, 0, 3), np.uint8), depth=depth, opacity=opacity,
        )  # fmt: skip
