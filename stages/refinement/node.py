"""Refinement as a process: estimates and frames in, poses out."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fieldpose.bus.messages import Estimate, Frame, Message, Pose, Reason
from fieldpose.bus.node import Joined, JoinedHandler
from fieldpose.bus.topics import ESTIMATE, FRAME, POSE
from fieldpose.stages.nerf.rendering_api import RayRenderer
from fieldpose.stages.refinement.core import RefinementConfig, RefinementResult, refine
from fieldpose.stages.wire import FrameImages


class RefinementNode(JoinedHandler):
    """Refines each estimate by the field that `make_renderer` gives at start; hands it on as it is where it cannot.

    It does not even read frames where refinement is off.
    """

    name = "refinement"
    output = POSE
    optional = (FRAME,)

    def __init__(self, make_renderer: Callable[[], RayRenderer], config: RefinementConfig, images: FrameImages) -> None:
        self.inputs = (ESTIMATE, FRAME) if config.on else (ESTIMATE,)
        super().__init__()
        self._make_renderer, self._config, self._images = make_renderer, config, images

    def start(self) -> None:
        if self._config.on:
            self._renderer = self._make_renderer()

    def answer(self, joined: Joined) -> Message | Reason:
        estimate = joined[ESTIMATE]
        result = self._refined(estimate, joined.get(FRAME))
        return Pose(
            header=joined.header, refined=result.refined, cam_from_object=result.cam_from_object,
            covariance=estimate.covariance if result.covariance is None else result.covariance,
            inliers=len(estimate.inliers_in_frame), correspondences=estimate.correspondences,
            residual_px=estimate.residual_px, loss_before=result.loss_before, loss_after=result.loss_after,
        )  # fmt: skip

    def _refined(self, estimate: Estimate, frame: Frame | None) -> RefinementResult:
        pose, image = np.array(estimate.cam_from_object), None if frame is None else self._images.of(frame)
        if frame is None or image is None:
            return RefinementResult(pose, False, None, None, 0)
        return refine(self._renderer, image, frame.camera, pose, estimate.inliers_in_frame, self._config)
