"""Refinement as a process: estimates and frames in, poses out."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import cast

import numpy as np

from fieldpose.bus.messages import Estimate, Frame, Header, Message, Pose, Reason
from fieldpose.bus.node import JoinedHandler, Output, reply_header
from fieldpose.bus.topics import ESTIMATE, FRAME, POSE, Topic
from fieldpose.stages.nerf.loading import load_renderer, warm_up
from fieldpose.stages.refinement.core import RefinementConfig, RefinementResult, refine
from fieldpose.stages.wire import camera_of, frame_image, frame_rng


class RefinementNode(JoinedHandler):
    """Refines each estimate, and hands it on as it is where it cannot. Raises FieldFileError at start."""

    name = "refinement"
    outputs: tuple[Topic, ...] = (POSE,)

    def __init__(self, field: Path, config: RefinementConfig, threads: int = 1) -> None:
        self.inputs = (ESTIMATE, FRAME) if config.on else (ESTIMATE,)
        super().__init__()
        self._field, self._config, self._threads = field, config, threads

    def start(self) -> None:
        self._renderer = load_renderer(self._field, self._threads)
        warm_up(self._renderer, jacobian=self._config.on and self._config.derivative == "field")

    def process(self, joined: dict[Topic, Message]) -> Iterable[Output]:
        estimate, frame = cast(Estimate, joined[ESTIMATE]), cast(Frame | None, joined.get(FRAME))
        pose = np.array(estimate.cam_from_object, np.float64)
        image, result = None if frame is None else frame_image(frame), RefinementResult(pose, False, None, None, 0)
        if image is not None:
            result = refine(
                self._renderer, image, camera_of(estimate.camera), pose, estimate.inliers_in_frame,
                frame_rng(estimate.header), self._config,
            )  # fmt: skip
        yield POSE, Pose(
            header=reply_header(estimate.header), ok=True, reason=Reason.OK, refined=result.refined,
            cam_from_object=result.cam_from_object,
            covariance=estimate.covariance if result.covariance is None else result.covariance,
            inliers=len(estimate.inliers_in_frame), correspondences=estimate.correspondences,
            residual_px=estimate.residual_px, loss_before=result.loss_before, loss_after=result.loss_after,
        )  # fmt: skip

    def incomplete(self, joined: dict[Topic, Message], reason: Reason) -> Iterable[Output]:
        return self.process(joined)

    def failure(self, header: Header, reason: Reason) -> Iterable[Output]:
        yield POSE, Pose(
            header=reply_header(header), ok=False, reason=reason, cam_from_object=None, covariance=None, inliers=0,
            correspondences=0, residual_px=None, refined=False, loss_before=None, loss_after=None,
        )  # fmt: skip
