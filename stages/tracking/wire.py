"""Between the Tracker's plain values and the messages on the bus."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from fieldpose.bus.messages import (
    CameraInfo,
    Failure,
    Followed,
    Frame,
    Guess,
    Header,
    Pose,
    Reason,
    Retrieved,
    Search,
    State,
)
from fieldpose.bus.node import Output, first_header
from fieldpose.bus.topics import FOLLOWED, GUESS, SEARCH, STATE
from fieldpose.stages.following.wire import in_frame
from fieldpose.stages.geometry import RIGID_TOLERANCE, is_rigid
from fieldpose.stages.tracking import core
from fieldpose.stages.tracking.following import FollowedReport
from fieldpose.stages.tracking.policy import Alike, FrameInfo, PoseResult

Said = core.Output | FollowedReport
"""What the Tracker wants said."""


def frame_info(message: CameraInfo | Frame) -> FrameInfo:
    """What the Tracker needs of a frame."""
    header = message.header
    return FrameInfo(header.frame_id, header.capture_ns, message.camera, message.camera_origin)


def pose_result(pose: Pose) -> PoseResult:
    """What the Tracker needs of a Pose message; a pose that is no rigid transform is a failure."""
    header, matrix = pose.header, copied(pose.cam_from_object)
    if not is_rigid(matrix, RIGID_TOLERANCE):
        return PoseResult(header.frame_id, header.pass_index, reason=Reason.IMPLAUSIBLE_POSE)
    return PoseResult(
        header.frame_id, header.pass_index, matrix, copied(pose.covariance), pose.inliers, pose.correspondences,
        pose.residual_px,
    )  # fmt: skip


def failed(failure: Failure) -> PoseResult:
    """A pass without a pose."""
    return PoseResult(failure.header.frame_id, failure.header.pass_index, reason=failure.reason)


def alike(message: Retrieved | Failure) -> Alike:
    """What retrieval has found, or why it has not."""
    if isinstance(message, Failure):
        return Alike(reason=message.reason)
    return Alike(list(copied(message.cam_from_object)))


def copied(array: np.ndarray) -> np.ndarray:
    """An array of its own: one of a message is a view of all its bytes, read-only and maybe unaligned."""
    return np.array(array, dtype=np.float64)


def outputs_of(outputs: Iterable[Said]) -> Iterator[Output]:
    """The messages that say what the Tracker wants said."""
    for output in outputs:
        header = first_header(output.frame.frame_id, output.frame.capture_ns, output.pass_index)
        match output:
            case core.LookOrder():
                yield SEARCH, Search(header=header)
            case core.GuessOrder(frame=frame, guess=guess):
                pose = guess.cam_from_object
                yield GUESS, Guess(header=header, reason=guess.reason, cam_from_object=pose, camera=frame.camera)
            case FollowedReport():
                yield FOLLOWED, _followed(header, output)
            case core.StateReport():
                yield STATE, _state(output)


def _followed(header: Header, report: FollowedReport) -> Followed:
    followed, camera = report.followed, report.frame.camera
    return Followed(
        header=header, cam_from_object=followed.cam_from_object, covariance=followed.covariance,
        pixels_in_frame=in_frame(followed, camera), found=followed.found, residual_px=followed.residual_px,
        level=followed.level,
    )  # fmt: skip


def _state(report: core.StateReport) -> State:
    belief, counts, frame = report.belief, report.counts, report.frame
    return State(
        header=first_header(frame.frame_id, frame.capture_ns, report.pass_index),
        state=belief.state,
        score=belief.score,
        cam_from_object=belief.cam_from_object,
        covariance=belief.covariance,
        reason=belief.reason,
        camera_origin=frame.camera_origin,
        in_flight=counts.in_flight,
        admitted=counts.admitted,
        finished=counts.finished,
        dropped_at_the_door=counts.dropped_at_the_door,
        lost=counts.lost,
        level=report.level,
    )
