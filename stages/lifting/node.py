"""Lifting as a process: matches, their view and guess in, correspondences out."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import cast

import numpy as np

from fieldpose.bus.messages import Correspondences, Guess, Header, Matches, Message, Reason, View
from fieldpose.bus.node import JoinedHandler, Output, reply_header
from fieldpose.bus.topics import CORRESPONDENCES, GUESS, MATCHES, VIEW, Topic
from fieldpose.stages.lifting.config import LiftingConfig
from fieldpose.stages.lifting.core import ConsistencyMemory, lift
from fieldpose.stages.nerf.loading import load_renderer, warm_up
from fieldpose.stages.wire import NO_CAMERA, camera_of, frame_rng


class LiftingNode(JoinedHandler):
    """Lifts the matches of each view; the guess tells the frame's camera. Raises FieldFileError at start."""

    name = "lifting"
    inputs: tuple[Topic, ...] = (MATCHES, VIEW, GUESS)
    outputs: tuple[Topic, ...] = (CORRESPONDENCES,)

    def __init__(self, field: Path, config: LiftingConfig, threads: int = 1) -> None:
        super().__init__()
        self._field, self._config, self._threads = field, config, threads

    def start(self) -> None:
        self._renderer, self._memory = load_renderer(self._field, self._threads), ConsistencyMemory()
        warm_up(self._renderer)

    def process(self, joined: dict[Topic, Message]) -> Iterable[Output]:
        matches, view = cast(Matches, joined[MATCHES]), cast(View, joined[VIEW])
        guess, header = cast(Guess, joined[GUESS]), reply_header(matches.header)
        lifted = lift(
            self._renderer, view.depth, view.opacity, camera_of(view.camera), np.array(view.cam_from_object),
            matches.pixels_in_view, frame_rng(header), self._config, self._memory.of(view.view_id),
        )  # fmt: skip
        ok = bool(lifted.kept.sum() >= self._config.min_kept)
        reason = Reason.OK if ok else Reason.TOO_FEW_CONSISTENT_POINTS
        yield CORRESPONDENCES, Correspondences(
            header=header, ok=ok, reason=reason, camera=guess.camera, guess_cam_from_object=guess.cam_from_object,
            pixels_in_frame=matches.pixels_in_frame, points_in_object=lifted.points_in_object,
            confidence=matches.confidence, consistency=lifted.consistency, kept=lifted.kept,
        )  # fmt: skip

    def failure(self, header: Header, reason: Reason) -> Iterable[Output]:
        none = np.zeros(0, np.float32)
        yield CORRESPONDENCES, Correspondences(
            header=reply_header(header), ok=False, reason=reason, camera=NO_CAMERA, guess_cam_from_object=np.eye(4),
            pixels_in_frame=none.reshape(0, 2), points_in_object=none.reshape(0, 3), confidence=none,
            consistency=none, kept=np.zeros(0, bool),
        )  # fmt: skip
