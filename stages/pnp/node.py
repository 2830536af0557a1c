"""PnP as a process: correspondences in, estimates out."""

from __future__ import annotations

from collections.abc import Iterable
from typing import cast

import numpy as np

from bus.messages import Correspondences, Estimate, Header, Message, Reason
from bus.node import JoinedHandler, Output, reply_header
from bus.topics import CORRESPONDENCES, ESTIMATE, Topic
from stages.pnp.config import PnpConfig
from stages.pnp.core import solve
from stages.wire import NO_CAMERA, camera_of


class PnpNode(JoinedHandler):
    """Solves for the pose of each frame from its kept correspondences."""

    name = "pnp"
    inputs: tuple[Topic, ...] = (CORRESPONDENCES,)
    outputs: tuple[Topic, ...] = (ESTIMATE,)

    def __init__(self, config: PnpConfig) -> None:
        super().__init__()
        self._config = config

    def process(self, joined: dict[Topic, Message]) -> Iterable[Output]:
        given = cast(Correspondences, joined[CORRESPONDENCES])
        kept = np.array(given.kept)
        pixels = given.pixels_in_frame[kept]
        result = solve(
            pixels, given.points_in_object[kept], camera_of(given.camera), self._config, given.confidence[kept],
            np.array(given.guess_cam_from_object),
        )  # fmt: skip
        yield ESTIMATE, Estimate(
            header=reply_header(given.header),
            ok=result.ok,
            reason=Reason(result.reason),
            cam_from_object=result.cam_from_object,
            covariance=result.covariance,
            camera=given.camera,
            inliers_in_frame=pixels[result.inliers],
            correspondences=len(pixels),
            residual_px=result.residual_px,
        )  # fmt: skip

    def failure(self, header: Header, reason: Reason) -> Iterable[Output]:
        yield ESTIMATE, Estimate(
            header=reply_header(header), ok=False, reason=reason, cam_from_object=None, covariance=None,
            camera=NO_CAMERA, inliers_in_frame=np.zeros((0, 2), np.float32), correspondences=0, residual_px=None,
        )  # fmt: skip
