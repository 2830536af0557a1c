"""Rendering as a process: guesses in, views out."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fieldpose.bus.messages import GuessReason, Message, Reason, View
from fieldpose.bus.node import Joined, JoinedHandler
from fieldpose.bus.topics import GUESS, VIEW
from fieldpose.stages.rendering.core import ViewSource, opacity_bytes


class RenderingNode(JoinedHandler):
    """Answers each guess with the view there, from what `make_views` gives at start."""

    name = "rendering"
    inputs = (GUESS,)
    output = VIEW

    def __init__(self, make_views: Callable[[], ViewSource]) -> None:
        super().__init__()
        self._make_views = make_views

    def start(self) -> None:
        self._views = self._make_views()

    def answer(self, joined: Joined) -> Message | Reason:
        guess = joined[GUESS]
        next_pass = guess.reason is GuessReason.NEXT_PASS
        sourced = self._views.view(guess.camera, np.array(guess.cam_from_object), next_pass)
        if isinstance(sourced, Reason):
            return sourced
        view = sourced.view
        return View(
            header=joined.header, view_id=sourced.view_id, cam_from_object=view.cam_from_object, camera=view.camera,
            rgb=view.rgb, depth=view.depth, opacity=opacity_bytes(view.opacity),
        )  # fmt: skip
