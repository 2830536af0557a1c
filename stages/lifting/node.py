"""Lifting as a process: matches and their view in, correspondences out."""

from __future__ import annotations

import hashlib
from collections.abc import Callable

import numpy as np

from fieldpose.bus.messages import Correspondences, Message, Reason
from fieldpose.bus.node import Joined, JoinedHandler
from fieldpose.bus.topics import CORRESPONDENCES, MATCHES, VIEW
from fieldpose.stages.lifting.config import LiftingConfig
from fieldpose.stages.lifting.core import ConsistencyMemory, lift
from fieldpose.stages.nerf.rendering_api import RayRenderer


class LiftingNode(JoinedHandler):
    """Lifts the matches of each view, by the field that `make_renderer` gives at start."""

    name = "lifting"
    inputs = (MATCHES, VIEW)
    output = CORRESPONDENCES

    def __init__(
        self, make_renderer: Callable[[], RayRenderer], config: LiftingConfig, memory: ConsistencyMemory
    ) -> None:
        super().__init__()
        self._make_renderer, self._config, self._memory = make_renderer, config, memory

    def start(self) -> None:
        self._renderer = self._make_renderer()

    def answer(self, joined: Joined) -> Message | Reason:
        matches, view = joined[MATCHES], joined[VIEW]
        pose = np.array(view.cam_from_object)
        lifted = lift(
            self._renderer, view.depth, view.opacity, view.camera, pose, matches.pixels_in_view,
            view_rng(view.view_id), self._config, self._memory.of(view.view_id),
        )  # fmt: skip
        if isinstance(lifted, Reason):
            return lifted
        return Correspondences(
            header=joined.header, view_cam_from_object=pose, pixels_in_frame=matches.pixels_in_frame,
            points_in_object=lifted.points_in_object, confidence=matches.confidence, consistency=lifted.consistency,
            kept=lifted.kept,
        )  # fmt: skip


def view_rng(view_id: str) -> np.random.Generator:
    """Random numbers that a view has each time: a point's consistency is then the same whichever frame asks for it."""
    return np.random.default_rng(int.from_bytes(hashlib.sha256(view_id.encode()).digest()[:8], "little"))
