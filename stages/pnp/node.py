"""PnP as a process: correspondences, the view that they were seen in and the frame in, estimates out."""

from __future__ import annotations

from collections.abc import Iterable
from typing import cast

import numpy as np

from fieldpose.bus.messages import Correspondences, Estimate, Frame, Header, Message, Reason, View
from fieldpose.bus.node import JoinedHandler, Output, reply_header
from fieldpose.bus.topics import CORRESPONDENCES, ESTIMATE, FRAME, VIEW, Topic
from fieldpose.stages.pnp.config import PnpConfig
from fieldpose.stages.pnp.core import Pictures, solve, warm_up
from fieldpose.stages.wire import NO_CAMERA, camera_of, frame_image


class PnpNode(JoinedHandler):
    """Solves for the pose of each frame from its kept correspondences; without pictures where these do not come."""

    name = "pnp"
    outputs: tuple[Topic, ...] = (ESTIMATE,)

    def __init__(self, config: PnpConfig) -> None:
        self.inputs = (CORRESPONDENCES, VIEW, FRAME) if config.align_levels > 0 else (CORRESPONDENCES,)
        super().__init__()
        self._config = config

    def start(self) -> None:
        warm_up(self._config)

    def process(self, joined: dict[Topic, Message]) -> Iterable[Output]:
        given = cast(Correspondences, joined[CORRESPONDENCES])
        kept = np.array(given.kept)
        result = solve(
            given.pixels_in_frame[kept], given.points_in_object[kept], camera_of(given.camera), self._config,
            given.confidence[kept], np.array(given.guess_cam_from_object), _pictures(joined),
        )  # fmt: skip
        yield ESTIMATE, Estimate(
            header=reply_header(given.header), ok=result.ok, reason=Reason(result.reason),
            cam_from_object=result.cam_from_object, covariance=result.covariance, camera=given.camera,
            inliers_in_frame=result.inliers_in_frame, correspondences=result.correspondences,
            residual_px=result.residual_px,
        )  # fmt: skip

    def incomplete(self, joined: dict[Topic, Message], reason: Reason) -> Iterable[Output]:
        return self.process(joined)

    def failure(self, header: Header, reason: Reason) -> Iterable[Output]:
        yield ESTIMATE, Estimate(
            header=reply_header(header), ok=False, reason=reason, cam_from_object=None, covariance=None,
            camera=NO_CAMERA, inliers_in_frame=np.zeros((0, 2), np.float32), correspondences=0, residual_px=None,
        )  # fmt: skip


def _pictures(joined: dict[Topic, Message]) -> Pictures | None:
    view, frame = cast(View | None, joined.get(VIEW)), cast(Frame | None, joined.get(FRAME))
    image = None if frame is None else frame_image(frame)
    if view is None or image is None:
        return None
    return Pictures(view.rgb, view.depth, camera_of(view.camera), np.array(view.cam_from_object), image)
