"""One valid message of every type, and the address that the bus tests send them to."""

from __future__ import annotations

from typing import Any

import numpy as np

from fieldpose.bus import topics
from fieldpose.bus.messages import (
    CameraInfo,
    CameraOrigin,
    Control,
    Correspondences,
    Estimate,
    Failure,
    Followed,
    Frame,
    Guess,
    GuessReason,
    Header,
    Matches,
    Message,
    Pose,
    Prior,
    Reason,
    Retrieved,
    Search,
    State,
    Stats,
    TrackingState,
    Truth,
    View,
)
from fieldpose.bus.ports import first_header
from fieldpose.bus.topics import Address, Topic
from fieldpose.stages.geometry import Camera

ADDRESS = Address("test", "mug", "cam")
CAMERA = Camera(6, 4, 5.0, 5.0, 2.5, 1.5, (0.1, 0.0, 0.0, 0.0, -0.2))


def pixels(count: int, columns: int = 2) -> np.ndarray:
    return np.arange(count * columns, dtype=np.float32).reshape(count, columns)


def scores(count: int) -> np.ndarray:
    return np.linspace(0, 1, count, dtype=np.float32)


def frame(frame_id: int = 0, width: int = 6, height: int = 4, header: Header | None = None) -> Frame:
    image = np.random.default_rng(frame_id).integers(0, 256, (height, width, 3), dtype=np.uint8)
    camera = Camera(width, height, 5.0, 5.0, 2.5, 1.5)
    return Frame(header=header or first_header(frame_id, 1000 + frame_id), image=image, encoding="rgb8", camera=camera)


def camera_info(frame_id: int = 0) -> CameraInfo:
    header = first_header(frame_id, 1000 + frame_id)
    return CameraInfo(header=header, camera=CAMERA, camera_origin=CameraOrigin.ASSUMED)


def truth(frame_id: int = 0) -> Truth:
    return Truth(header=first_header(frame_id, 1000 + frame_id), cam_from_object=np.eye(4))


def prior(frame_id: int = 0) -> Prior:
    return Prior(header=first_header(frame_id, 1000 + frame_id), cam_from_object=np.eye(4))


def guess(frame_id: int = 0, pass_index: int = 0) -> Guess:
    header = first_header(frame_id, 1000 + frame_id, pass_index)
    return Guess(header=header, reason=GuessReason.PRIOR, cam_from_object=np.eye(4), camera=CAMERA)


def view(frame_id: int = 0, pass_index: int = 0) -> View:
    return View(
        header=first_header(frame_id, 1000 + frame_id, pass_index),
        view_id="v1",
        cam_from_object=np.eye(4),
        camera=CAMERA,
        rgb=np.full((4, 6, 3), 7, np.uint8),
        depth=np.ones((4, 6), np.float32),
        opacity=np.full((4, 6), 255, np.uint8),
    )


def matches(header: Header, count: int = 5) -> Matches:
    return Matches(
        header=header,
        view_id="v1",
        pixels_in_view=pixels(count),
        pixels_in_frame=pixels(count),
        confidence=scores(count),
    )


def failure(frame_id: int = 0, stage: str = "matching", reason: Reason = Reason.TOO_FEW_MATCHES) -> Failure:
    return Failure(header=first_header(frame_id, 1000 + frame_id), stage=stage, reason=reason)


def every_message() -> dict[Topic[Any], Message]:
    """One message for each topic of the table."""
    header = first_header(3, 1003, 1)
    pose: dict[str, Any] = {"cam_from_object": np.eye(4), "covariance": np.eye(6)}
    return {
        topics.FRAME: frame(3),
        topics.CAMERA_INFO: camera_info(3),
        topics.TRUTH: Truth(header=header, cam_from_object=None),
        topics.PRIOR: prior(3),
        topics.SEARCH: Search(header=header),
        topics.RETRIEVED: Retrieved(
            header=header, cam_from_object=np.stack([np.eye(4)] * 5), similarity=scores(5)[::-1].copy()
        ),
        topics.GUESS: guess(3),
        topics.VIEW: view(3),
        topics.MATCHES: matches(header),
        topics.CORRESPONDENCES: Correspondences(
            header=header,
            view_cam_from_object=np.eye(4),
            pixels_in_frame=pixels(5),
            points_in_object=pixels(5, 3),
            confidence=scores(5),
            consistency=scores(5),
            kept=np.array([True, False, True, True, False]),
        ),
        topics.ESTIMATE: Estimate(
            header=header, **pose, inliers_in_frame=pixels(3), correspondences=5, residual_px=0.5
        ),
        topics.POSE: Pose(
            header=header,
            **pose,
            inliers=3,
            correspondences=5,
            residual_px=0.5,
            refined=True,
            loss_before=2.0,
            loss_after=1.0,
        ),
        topics.FAILURE: failure(3),
        topics.FOLLOWED: Followed(
            header=header,
            **pose,
            pixels_in_frame=np.zeros((2, 2), np.float32),
            found=np.array([True, False]),
            residual_px=0.3,
            level=1,
        ),
        topics.STATE: State(
            header=header,
            state=TrackingState.LIMITED,
            score=0.0,
            **pose,
            reason=Reason.TOO_FEW_MATCHES,
            camera_origin=CameraOrigin.ASSUMED,
            in_flight=1,
            admitted=9,
            finished=8,
            dropped_at_the_door=4,
            lost=0,
        ),
        topics.CONTROL: Control(
            header=header, request="set_guess", after_frame=2, cam_from_object=np.eye(4), solves_per_s=None
        ),
        topics.STATS: Stats(
            header=header,
            stage="pnp",
            ready=True,
            received=5,
            published=4,
            refused=0,
            gaps=0,
            skipped=0,
            failed=0,
            busy_ms_p50=1.5,
            busy_ms_p90=2.5,
            busy_s=0.5,
            cpu_s=3.0,
            rss_mb=80.0,
        ),
    }


def same(a: Any, b: Any) -> bool:
    """Whether two messages are equal, arrays by type, shape and value."""
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and np.array_equal(a, b)
    if isinstance(a, Message):
        return type(a) is type(b) and all(same(getattr(a, f), getattr(b, f)) for f in a.__struct_fields__)
    return bool(a == b)
