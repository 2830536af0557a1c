"""PnP as a process: correspondences, the view that they were seen in and the frame in, estimates out."""

from __future__ import annotations

import numpy as np

from fieldpose.bus.messages import Estimate, Frame, Message, Reason, View
from fieldpose.bus.node import Joined, JoinedHandler
from fieldpose.bus.topics import CORRESPONDENCES, ESTIMATE, FRAME, VIEW
from fieldpose.stages.pnp.config import PnpConfig
from fieldpose.stages.pnp.core import Pictures, solve, warm_up
from fieldpose.stages.wire import FrameImages


class PnpNode(JoinedHandler):
    """Solves for the pose of each frame from its kept correspondences; without pictures where the view is missing."""

    name = "pnp"
    inputs = (CORRESPONDENCES, VIEW, FRAME)
    output = ESTIMATE
    optional = (VIEW,)

    def __init__(self, config: PnpConfig, images: FrameImages) -> None:
        super().__init__()
        self._config, self._images = config, images

    def start(self) -> None:
        warm_up(self._config)

    def answer(self, joined: Joined) -> Message | Reason:
        given, frame = joined[CORRESPONDENCES], joined[FRAME]
        kept = np.array(given.kept)
        solved = solve(
            given.pixels_in_frame[kept], given.points_in_object[kept], frame.camera, self._config,
            given.confidence[kept], np.array(given.view_cam_from_object), self._pictures(joined.get(VIEW), frame),
        )  # fmt: skip
        if isinstance(solved, Reason):
            return solved
        return Estimate(
            header=joined.header, cam_from_object=solved.cam_from_object, covariance=solved.covariance,
            inliers_in_frame=solved.inliers_in_frame, correspondences=solved.correspondences,
            residual_px=solved.residual_px,
        )  # fmt: skip

    def _pictures(self, view: View | None, frame: Frame) -> Pictures | None:
        image = None if view is None or self._config.align_levels == 0 else self._images.of(frame)
        if view is None or image is None:
            return None
        return Pictures(view.rgb, view.depth, view.camera, np.array(view.cam_from_object), image)
