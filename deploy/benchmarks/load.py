"""What a pipeline that works at full rate says about each frame, sent from a process of its own."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np

from fieldpose.bus import topics
from fieldpose.bus.messages import (
    CameraInfo,
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
from fieldpose.bus.ports import Outbox, first_header
from fieldpose.bus.topics import Address, Topic
from fieldpose.deploy.benchmarks.echo import session
from fieldpose.deploy.processes.lifeline import die_with_parent
from fieldpose.stages.geometry import Camera

_POINTS, _FOLLOWED, _RETRIEVED = 500, 100, 5
_SETTLE_S = 20.0
SENDER = "bench"


class Sent(msgspec.Struct):
    """How many messages were sent by topic, and how long that took; behind_s: the most that a frame came too late."""

    by_topic: dict[str, int]
    seconds: float
    behind_s: float


def messages(header: Header, width: int, height: int, noise: np.ndarray) -> Iterator[tuple[Topic[Any], Message]]:
    """One of every topic that is recorded; frame and view have (width, height) pixels, cut from (h, w, 3) noise."""
    camera = Camera(width, height, width, width, width / 2, height / 2)
    pose: dict[str, Any] = {"cam_from_object": np.eye(4), "covariance": np.eye(6)}
    pixels, scores = np.zeros((_POINTS, 2), np.float32), np.zeros(_POINTS, np.float32)
    at = header.frame_id % (noise.shape[0] - height)
    image = noise[at : at + height]
    yield topics.FRAME, Frame(header=header, image=image, encoding="rgb8", camera=camera)
    yield topics.CAMERA_INFO, CameraInfo(header=header, camera=camera)
    yield topics.TRUTH, Truth(header=header, cam_from_object=np.eye(4))
    yield topics.PRIOR, Prior(header=header, cam_from_object=np.eye(4))
    yield topics.SEARCH, Search(header=header)
    yield topics.RETRIEVED, Retrieved(
        header=header, cam_from_object=np.stack([np.eye(4)] * _RETRIEVED), similarity=np.ones(_RETRIEVED, np.float32)
    )  # fmt: skip
    yield topics.GUESS, Guess(header=header, reason=GuessReason.PRIOR, cam_from_object=np.eye(4), camera=camera)
    depth, opacity = image[..., 0].astype(np.float32), np.ascontiguousarray(image[..., 1])
    yield topics.VIEW, View(
        header=header, view_id="v", cam_from_object=np.eye(4), camera=camera, rgb=image, depth=depth, opacity=opacity
    )  # fmt: skip
    yield topics.MATCHES, Matches(
        header=header, view_id="v", pixels_in_view=pixels, pixels_in_frame=pixels, confidence=scores
    )  # fmt: skip
    yield topics.CORRESPONDENCES, Correspondences(
        header=header, view_cam_from_object=np.eye(4), pixels_in_frame=pixels, confidence=scores, consistency=scores,
        points_in_object=np.zeros((_POINTS, 3), np.float32), kept=np.ones(_POINTS, bool),
    )  # fmt: skip
    yield topics.ESTIMATE, Estimate(
        header=header, **pose, inliers_in_frame=pixels, correspondences=_POINTS, residual_px=0.5
    )  # fmt: skip
    yield topics.POSE, Pose(
        header=header, **pose, inliers=_POINTS, correspondences=_POINTS, residual_px=0.5, refined=False,
        loss_before=None, loss_after=None,
    )  # fmt: skip
    yield topics.FAILURE, Failure(header=header, stage="bench", reason=Reason.TOO_FEW_MATCHES)
    yield topics.FOLLOWED, Followed(
        header=header, **pose, pixels_in_frame=pixels[:_FOLLOWED], found=np.ones(_FOLLOWED, bool), residual_px=0.3,
        level=0,
    )  # fmt: skip
    yield topics.STATE, State(
        header=header, state=TrackingState.TRACKING, score=0.9, **pose, in_flight=1, admitted=1, finished=1,
        dropped_at_the_door=0, lost=0,
    )  # fmt: skip
    yield topics.CONTROL, Control(
        header=header, request="reset", after_frame=None, cam_from_object=None, solves_per_s=None
    )  # fmt: skip
    yield topics.STATS, Stats(
        header=header, stage="bench", ready=True, received=0, published=0, refused=0, gaps=0, skipped=0, failed=0,
        busy_ms_p50=0.0, busy_ms_p90=0.0, cpu_s=0.0, rss_mb=0.0,
    )  # fmt: skip


def serve(endpoint: str, *load: str) -> None:
    """Send every topic for so many seconds at a rate, with images so wide and high; says what was sent, as JSON."""
    seconds, rate_hz = map(float, load[:2])
    width, height = map(int, load[2:])
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for who started this, who ends it
    die_with_parent()
    noise = np.random.default_rng(0).integers(0, 256, (height + 64, width, 3), np.uint8)
    with session(endpoint) as bus:
        bus.settle(_SETTLE_S, images=True)
        outbox, sent = Outbox(bus, Address(), SENDER), Sent({}, 0.0, 0.0)
        began = time.monotonic()
        for number in range(max(1, round(seconds * rate_hz))):
            late = time.monotonic() - began - number / rate_hz
            sent.behind_s = max(sent.behind_s, late)
            time.sleep(max(0.0, -late))
            for topic, message in messages(first_header(number, time.time_ns()), width, height, noise):
                outbox.publish(topic, message)
                sent.by_topic[topic.name] = sent.by_topic.get(topic.name, 0) + 1
        sent.seconds = time.monotonic() - began
        # Once this has come back everything before it has been taken over.
        bus.settle(_SETTLE_S, images=True)
        sys.stdout.buffer.write(msgspec.json.encode(sent))
        sys.stdout.flush()
