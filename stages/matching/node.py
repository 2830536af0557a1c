"""Matching as a process: views and frames in, matches out."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fieldpose.bus.messages import Matches, Message, Reason
from fieldpose.bus.node import Joined, JoinedHandler
from fieldpose.bus.topics import FRAME, MATCHES, VIEW
from fieldpose.stages.matching.core import PairMatcher
from fieldpose.stages.wire import FrameImages

_USUAL_ASPECT = 3 / 4


class MatchingNode(JoinedHandler):
    """Matches each view with its frame, by what `make_pairs` gives at start."""

    name = "matching"
    inputs = (VIEW, FRAME)
    output = MATCHES

    def __init__(self, make_pairs: Callable[[], PairMatcher], images: FrameImages, view_size: int) -> None:
        super().__init__()
        self._make_pairs, self._images, self._view_size = make_pairs, images, view_size

    def start(self) -> None:
        self._pairs = self._make_pairs()
        shape = (round(_USUAL_ASPECT * self._view_size), self._view_size, 3)
        noise = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
        solid = np.ones(noise.shape[:2], np.float32)
        # The first inferences are slow, for networks choose their kernels in them, for each shape: for two images, and
        # for one, which a frame is whose view comes again.
        for frame_key in ("warm-up", "again"):
            self._pairs.match(noise, solid, noise, "warm-up", frame_key)

    def answer(self, joined: Joined) -> Message | Reason:
        view, image = joined[VIEW], self._images.of(joined[FRAME])
        if image is None:
            return Reason.FRAME_UNREADABLE
        matched = self._pairs.match(view.rgb, view.opacity, image, view.view_id, joined.frame_key)
        if isinstance(matched, Reason):
            return matched
        return Matches(
            header=joined.header, view_id=view.view_id, pixels_in_view=matched.pixels_a,
            pixels_in_frame=matched.pixels_b, confidence=matched.confidence,
        )  # fmt: skip
