"""Numbers of a pipeline as flat JSON objects with a schema, for plots and tables; what is not known is left out."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType

from fieldpose.bus.messages import Followed, Pose, State, Stats
from fieldpose.deploy.graph import AT_WORK
from fieldpose.deploy.reporting.results import FrameResult
from fieldpose.stages.tracking.scoring import deviations

Known = float | UnsetType


class StateFigures(msgspec.Struct, kw_only=True):
    """Of one frame's state. sure: the pose was measured, and tracking is sure of it.

    rate_hz: states a second lately. stage_ms: name of a process -> milliseconds, waiting included. sigma: standard
    deviations of the pose's left twist, three of the translation (field units), three of the rotation (radians).
    """

    frame_id: int
    state: str
    sure: bool
    score: float
    reason: str
    camera_origin: str
    in_flight: int
    admitted: int
    finished: int
    dropped_at_the_door: int
    lost: int
    level: int
    rate_hz: Known = UNSET
    latency_ms: Known = UNSET
    stage_ms: dict[str, float]
    sigma: list[float]
    sigma_translation: Known = UNSET
    sigma_rotation_deg: Known = UNSET
    rotation_error_deg: Known = UNSET
    translation_error: Known = UNSET


class SolvedFigures(msgspec.Struct, kw_only=True):
    """Of one pass over a frame through all stages, as the message Pose has them."""

    frame_id: int
    pass_index: int
    inliers: int
    correspondences: int
    residual_px: float
    refined: bool
    loss_before: Known = UNSET
    loss_after: Known = UNSET


class FollowedFigures(msgspec.Struct, kw_only=True):
    """Of one frame that was followed: how many points were looked for and found."""

    frame_id: int
    points: int
    found: int
    residual_px: float
    level: int


class StatsFigures(msgspec.Struct, kw_only=True):
    """Of one process, as the message Stats has them."""

    stage: str
    ready: bool
    received: int
    published: int
    refused: int
    gaps: int
    skipped: int
    failed: int
    busy_ms_p50: float
    busy_ms_p90: float
    busy_s: float
    cpu_s: float
    rss_mb: float


def of_state(state: State, result: FrameResult, sure: bool, rate_hz: float | None) -> StateFigures:
    """result: what became of the state's frame."""
    shift, turn = (None, None) if state.covariance is None else deviations(state.covariance)
    turned, shifted = result.errors or (None, None)
    variances = () if state.covariance is None else np.maximum(np.diag(state.covariance), 0.0)
    return StateFigures(
        frame_id=state.header.frame_id,
        state=str(state.state),
        sure=sure,
        score=state.score,
        reason="" if state.reason is None else str(state.reason),
        camera_origin=str(state.camera_origin),
        in_flight=state.in_flight,
        admitted=state.admitted,
        finished=state.finished,
        dropped_at_the_door=state.dropped_at_the_door,
        lost=state.lost,
        level=state.level,
        rate_hz=_known(rate_hz),
        latency_ms=_known(result.latency_ms),
        stage_ms={name: ms for name, ms in result.stage_ms.items() if name in AT_WORK},
        sigma=np.sqrt(variances).tolist(),
        sigma_translation=_known(shift),
        sigma_rotation_deg=_known(turn),
        rotation_error_deg=_known(turned),
        translation_error=_known(shifted),
    )


def of_pose(pose: Pose) -> SolvedFigures:
    return SolvedFigures(
        frame_id=pose.header.frame_id,
        pass_index=pose.header.pass_index,
        inliers=pose.inliers,
        correspondences=pose.correspondences,
        residual_px=pose.residual_px,
        refined=pose.refined,
        loss_before=_known(pose.loss_before),
        loss_after=_known(pose.loss_after),
    )


def of_followed(followed: Followed) -> FollowedFigures:
    return FollowedFigures(
        frame_id=followed.header.frame_id,
        points=len(followed.found),
        found=int(followed.found.sum()),
        residual_px=followed.residual_px,
        level=followed.level,
    )


def of_stats(stats: Stats) -> StatsFigures:
    return StatsFigures(**{name: getattr(stats, name) for name in StatsFigures.__struct_fields__})


def schema_of(figures: type[msgspec.Struct]) -> bytes:
    """The JSON schema of such figures, whose outermost object has the properties itself, as Foxglove wants it."""
    _, parts = msgspec.json.schema_components((figures,))
    schema: dict[str, Any] = parts[figures.__name__]
    if "stage_ms" in schema["properties"]:
        schema["properties"]["stage_ms"]["properties"] = {name: {"type": "number"} for name in AT_WORK}
    return msgspec.json.encode(schema)


def _known(value: float | None) -> Known:
    return UNSET if value is None else value
