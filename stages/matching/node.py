"""Matching as a process: views and frames in, matches out."""

from __future__ import annotations

from collections.abc import Iterable
from typing import cast

import numpy as np

from fieldpose.bus.messages import Frame, Header, Matches, Message, Reason, View
from fieldpose.bus.node import JoinedHandler, Output, reply_header
from fieldpose.bus.topics import FRAME, MATCHES, VIEW, Topic
from fieldpose.stages.matching.core import MatchingConfig, PairMatcher, build_matcher
from fieldpose.stages.wire import frame_image


class MatchingNode(JoinedHandler):
    """Matches each view with its frame. Raises ConfigError and WeightsError at start."""

    name = "matching"
    inputs: tuple[Topic, ...] = (VIEW, FRAME)
    outputs: tuple[Topic, ...] = (MATCHES,)

    def __init__(self, config: MatchingConfig) -> None:
        super().__init__()
        self._config = config

    def start(self) -> None:
        matcher = build_matcher(self._config)
        self._pairs = PairMatcher(matcher, self._config)
        noise = np.random.default_rng(0).integers(0, 256, (400, 400, 3), np.uint8)
        solid, once = np.ones((400, 400), np.float32), PairMatcher(matcher, self._config)
        # The first inferences are slow, for networks choose their kernels in them: for two images, and for one, which
        # a frame is whose view comes again.
        for frame_key in range(2):
            once.match(noise, solid, noise, "noise", frame_key)

    def process(self, joined: dict[Topic, Message]) -> Iterable[Output]:
        view, frame = cast(View, joined[VIEW]), cast(Frame, joined[FRAME])
        image = frame_image(frame)
        if image is None:
            yield from self.failure(view.header, Reason.FRAME_UNREADABLE)
            return
        frame_key = (frame.header.frame_id, frame.header.capture_ns)
        matched = self._pairs.match(view.rgb, view.opacity, image, view.view_id, frame_key)
        ok = len(matched.confidence) >= self._config.min_matches
        yield MATCHES, Matches(
            header=reply_header(view.header),
            ok=ok,
            reason=Reason.OK if ok else Reason.TOO_FEW_MATCHES,
            view_id=view.view_id,
            pixels_in_view=matched.pixels_a,
            pixels_in_frame=matched.pixels_b,
            confidence=matched.confidence,
        )  # fmt: skip

    def failure(self, header: Header, reason: Reason) -> Iterable[Output]:
        pixels, confidence = np.zeros((0, 2), np.float32), np.zeros(0, np.float32)
        yield MATCHES, Matches(
            header=reply_header(header), ok=False, reason=reason, view_id="",
            pixels_in_view=pixels, pixels_in_frame=pixels, confidence=confidence,
        )  # fmt: skip
