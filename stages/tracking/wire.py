"""Between the Tracker's plain values and the messages on the bus."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from fieldpose.bus.messages import Frame, Guess, Pose, State
from fieldpose.bus.node import Output, first_header
from fieldpose.bus.topics import GUESS, STATE
from fieldpose.stages.geometry import is_rigid
from fieldpose.stages.tracking import core
from fieldpose.stages.tracking.policy import FrameInfo, PoseResult

_RIGID_TOLERANCE = 1e-3


def frame_info(frame: Frame) -> FrameInfo:
    """What the Tracker needs of a Frame message."""
    return FrameInfo(frame.header.frame_id, frame.header.capture_ns, frame.camera)


def pose_result(pose: Pose) -> PoseResult:
    """What the Tracker needs of a Pose message; a pose that is no rigid transform is a failure."""
    matrix = copied(pose.cam_from_object)
    return PoseResult(
        frame_id=pose.header.frame_id,
        pass_index=pose.header.pass_index,
        ok=pose.ok and matrix is not None and is_rigid(matrix, _RIGID_TOLERANCE),
        cam_from_object=matrix,
        covariance=copied(pose.covariance),
        inliers=pose.inliers,
        correspondences=pose.correspondences,
        residual_px=pose.residual_px,
    )


def copied(array: np.ndarray | None) -> np.ndarray | None:
    """An array of its own: one of a message is a view of all its bytes, read-only and maybe unaligned."""
    return None if array is None else np.array(array, dtype=np.float64)


def outputs_of(outputs: Iterable[core.Output]) -> Iterator[Output]:
    """The messages that say what the Tracker wants said."""
    for output in outputs:
        header = first_header(output.frame.frame_id, output.frame.capture_ns, output.pass_index)
        if isinstance(output, core.GuessOrder):
            guess = output.guess
            yield (
                GUESS,
                Guess(
                    header=header,
                    reason=guess.reason,
                    cam_from_object=guess.cam_from_object,
                    camera=output.frame.camera,
                ),
            )
            continue
        belief, counts = output.belief, output.counts
        yield (
            STATE,
            State(
                header=header,
                state=belief.state,
                score=belief.score,
                cam_from_object=belief.cam_from_object,
                covariance=belief.covariance,
                in_flight=counts.in_flight,
                admitted=counts.admitted,
                finished=counts.finished,
                dropped_at_the_door=counts.dropped_at_the_door,
                lost=counts.lost,
            ),
        )
