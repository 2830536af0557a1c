"""Every message that crosses the bus, and nothing else.

Arrays are numpy arrays (read-only views after decoding). Poses are 4x4 float64 `cam_from_object`
matrices in OpenCV camera axes; lengths are in the field's unit; times are nanoseconds since the epoch.
Each type checks its own shapes when it is made, on the sending and on the receiving side alike.
"""

from __future__ import annotations

import math
from enum import StrEnum
from typing import Any, ClassVar, Literal

import msgspec
import numpy as np

from fieldpose.stages.geometry.cameras import Camera


class Reason(StrEnum):
    """Why there is no result."""

    INPUT_MISSING = "input_missing"
    FRAME_MISSING = "frame_missing"
    FRAME_UNREADABLE = "frame_unreadable"
    NOT_AVAILABLE = "not_available"
    NOTHING_ALIKE = "nothing_alike"
    NOTHING_IN_VIEW = "nothing_in_view"
    TOO_FEW_MATCHES = "too_few_matches"
    TOO_FEW_CONSISTENT_POINTS = "too_few_consistent_points"
    NO_CONSENSUS = "no_consensus"
    IMPLAUSIBLE_POSE = "implausible_pose"
    CAMERA_DIFFERS = "camera_differs"
    NO_ANSWER = "no_answer"
    NO_GUESS = "no_guess"
    INTERNAL_ERROR = "internal_error"
    RESET = "reset"


class GuessReason(StrEnum):
    """Where the pose that is rendered next comes from."""

    PRIOR = "prior"
    MOTION = "motion"
    KEYFRAME = "keyframe"
    RELOCALISATION = "relocalisation"
    NEXT_PASS = "next_pass"


class TrackingState(StrEnum):
    """How far tracking trusts its pose: TRACKING is sure, LIMITED is not, and the other two have none."""

    INITIALIZING = "initializing"
    TRACKING = "tracking"
    LIMITED = "limited"
    LOST = "lost"


class CameraOrigin(StrEnum):
    """Where a frame's intrinsics come from; those that were assumed make no pose certain."""

    CALIBRATED = "calibrated"
    TRAINING = "training"
    EXIF = "exif"
    ASSUMED = "assumed"


Encoding = Literal["rgb8", "jpeg", "png"]
Changes = Literal["reset", "set_guess", "set_solving", "take_keyframe"]


class Header(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """`sequence` counts from 0 per (source, topic), so that a receiver sees what it missed.

    instance: drawn by each sender when it begins, so that one is told from another of its name; 0 where none was.
    """

    source: str
    sequence: int
    frame_id: int
    pass_index: int
    capture_ns: int
    sent_ns: int
    instance: int = 0

    def __post_init__(self) -> None:
        numbers = (self.sequence, self.frame_id, self.pass_index, self.capture_ns, self.sent_ns, self.instance)
        if not all(0 <= number < 2**63 for number in numbers):
            raise ValueError("header: numbers must be from 0 to 2^63 - 1")
        if len(self.source) > 128:
            raise ValueError("header: source is longer than 128 characters")

    @property
    def frame_key(self) -> tuple[int, int]:
        """Tells the frame from all others of its camera."""
        return self.frame_id, self.capture_ns


class Checked(msgspec.Struct, kw_only=True, forbid_unknown_fields=True):
    """What checks itself; `_arrays` maps a field to its (dtype, shape), None where any length will do."""

    _arrays: ClassVar[dict[str, tuple[str, tuple[int | None, ...]]]] = {}

    def __post_init__(self) -> None:
        for name, (dtype, shape) in self._arrays.items():
            if getattr(self, name) is None and "None" not in type(self).__annotations__[name]:
                raise ValueError(f"{name}: missing")
            check_array(name, getattr(self, name), dtype, shape)
        for name in self.__struct_fields__:
            value = getattr(self, name)
            if isinstance(value, float) and not math.isfinite(value):
                raise ValueError(f"{name}: not finite")


class Message(Checked, kw_only=True):
    """Base of all messages on topics."""

    header: Header


def check_equal(what: str, sizes: dict[str, Any]) -> None:
    """Raise ValueError unless the sizes, by the name of their field, are all the same."""
    if len(set(sizes.values())) > 1:
        raise ValueError(f"{what} differs: " + ", ".join(f"{name} {size}" for name, size in sizes.items()))


def check_array(name: str, value: Any, dtype: str, shape: tuple[int | None, ...]) -> None:
    """Raise ValueError unless `value` is None or an array of that dtype and shape without NaN or infinity."""
    if value is None:
        return
    if value.dtype != np.dtype(dtype):
        raise ValueError(f"{name}: dtype {value.dtype} where {dtype} is expected")
    if value.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, value.shape, strict=True)):
        raise ValueError(f"{name}: shape {value.shape} where {shape} is expected")
    if value.dtype.kind == "f" and not np.all(np.isfinite(value)):
        raise ValueError(f"{name}: not finite")


POSE = ("float64", (4, 4))
COVARIANCE = ("float64", (6, 6))


class Frame(Message, kw_only=True):
    """A camera image: `rgb8` is (height, width, 3), `jpeg` and `png` are the (n,) bytes of the file."""

    image: np.ndarray
    encoding: Encoding
    camera: Camera
    camera_origin: CameraOrigin = CameraOrigin.CALIBRATED

    def __post_init__(self) -> None:
        super().__post_init__()
        shape = (self.camera.height, self.camera.width, 3) if self.encoding == "rgb8" else (None,)
        check_array("image", self.image, "uint8", shape)


class CameraInfo(Message, kw_only=True):
    """A frame without its pixels, for who needs none; it is sent right after the frame."""

    camera: Camera
    camera_origin: CameraOrigin = CameraOrigin.CALIBRATED


class Truth(Message, kw_only=True):
    """The true pose of a frame, where a dataset or a recording knows it; None where the object is out of view."""

    cam_from_object: np.ndarray | None
    _arrays: ClassVar = {"cam_from_object": POSE}


class Prior(Message, kw_only=True):
    """A guess of a frame's pose from outside: an inertial sensor, a robot arm's kinematics, or an evaluation."""

    cam_from_object: np.ndarray
    _arrays: ClassVar = {"cam_from_object": POSE}


class Search(Message, kw_only=True):
    """Asks which training views look like the frame."""


class Retrieved(Message, kw_only=True):
    """Training views that look like a frame, the most alike first; similarity in 0..1."""

    cam_from_object: np.ndarray
    similarity: np.ndarray
    _arrays: ClassVar = {"cam_from_object": ("float64", (None, 4, 4)), "similarity": ("float32", (None,))}

    def __post_init__(self) -> None:
        super().__post_init__()
        check_equal("length", {name: len(getattr(self, name)) for name in self._arrays})


class Guess(Message, kw_only=True):
    """The pose to render for an admitted frame, and the camera that the frame was taken with."""

    reason: GuessReason
    cam_from_object: np.ndarray
    camera: Camera
    _arrays: ClassVar = {"cam_from_object": POSE}


class View(Message, kw_only=True):
    """The field rendered at `cam_from_object`; depth is along the optical axis, 0 where nothing was hit.

    Renders reused for another guess keep their `view_id`. `camera` has no distortion; opacity is 0 to 255.
    """

    view_id: str
    cam_from_object: np.ndarray
    camera: Camera
    rgb: np.ndarray
    depth: np.ndarray
    opacity: np.ndarray
    _arrays: ClassVar = {
        "cam_from_object": POSE,
        "rgb": ("uint8", (None, None, 3)),
        "depth": ("float32", (None, None)),
        "opacity": ("uint8", (None, None)),
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        sizes = {name: getattr(self, name).shape[:2] for name in ("rgb", "depth", "opacity")}
        check_equal("size", {**sizes, "camera": (self.camera.height, self.camera.width)})


class Matches(Message, kw_only=True):
    """Pixels of the view and of the frame that show the same surface point; confidence in 0..1."""

    view_id: str
    pixels_in_view: np.ndarray
    pixels_in_frame: np.ndarray
    confidence: np.ndarray
    _arrays: ClassVar = {
        "pixels_in_view": ("float32", (None, 2)),
        "pixels_in_frame": ("float32", (None, 2)),
        "confidence": ("float32", (None,)),
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        check_equal("length", {name: len(getattr(self, name)) for name in self._arrays})


class Correspondences(Message, kw_only=True):
    """Matches lifted to the object: `consistency` is the paper's m in squared field units; `kept`: below gamma.

    view_cam_from_object: where the view was rendered that they were lifted from.
    """

    view_cam_from_object: np.ndarray
    pixels_in_frame: np.ndarray
    points_in_object: np.ndarray
    confidence: np.ndarray
    consistency: np.ndarray
    kept: np.ndarray
    _arrays: ClassVar = {
        "view_cam_from_object": POSE,
        "pixels_in_frame": ("float32", (None, 2)),
        "points_in_object": ("float32", (None, 3)),
        "confidence": ("float32", (None,)),
        "consistency": ("float32", (None,)),
        "kept": ("bool", (None,)),
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        rows = [name for name in self._arrays if name != "view_cam_from_object"]
        check_equal("length", {name: len(getattr(self, name)) for name in rows})


class Estimate(Message, kw_only=True):
    """The pose of one PnP; the covariance is of a left twist (translation, rotation) in the camera frame.

    correspondences: how many points the inliers were among, landmarks of the view that were looked for included.
    """

    cam_from_object: np.ndarray
    covariance: np.ndarray
    inliers_in_frame: np.ndarray
    correspondences: int
    residual_px: float
    _arrays: ClassVar = {
        "cam_from_object": POSE,
        "covariance": COVARIANCE,
        "inliers_in_frame": ("float32", (None, 2)),
    }


class Pose(Message, kw_only=True):
    """The result for a frame and pass: the estimate, or its refinement where that made the loss smaller.

    Losses are None where no refinement was tried.
    """

    cam_from_object: np.ndarray
    covariance: np.ndarray
    inliers: int
    correspondences: int
    residual_px: float
    refined: bool
    loss_before: float | None
    loss_after: float | None
    _arrays: ClassVar = {"cam_from_object": POSE, "covariance": COVARIANCE}


class Failure(Message, kw_only=True):
    """A stage has no result for a frame and pass; nothing follows from it, and tracking decides what is next."""

    stage: str
    reason: Reason


class Followed(Message, kw_only=True):
    """A frame's pose from points of views that exist, as measured: `State` has it filtered over time.

    pixels_in_frame: where points were looked for, in the frame's own pixels; found: which of them were found.
    level: how coarse the images were, 0 for not at all; blurred frames show no more.
    """

    cam_from_object: np.ndarray
    covariance: np.ndarray
    pixels_in_frame: np.ndarray
    found: np.ndarray
    residual_px: float
    level: int
    _arrays: ClassVar = {
        "cam_from_object": POSE,
        "covariance": COVARIANCE,
        "pixels_in_frame": ("float32", (None, 2)),
        "found": ("bool", (None,)),
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        check_equal("length", {name: len(getattr(self, name)) for name in ("pixels_in_frame", "found")})


class State(Message, kw_only=True):
    """What tracking believes after each frame, and what it has counted at its door since it started.

    A pose with a score of 0 was not measured but carried on from before; `reason` says why nothing was measured, or why
    what was is not sure (camera_differs: the focal length is not as said).
    level: how much following does less than it might, for want of time; 0 for nothing less.
    """

    state: TrackingState
    score: float
    cam_from_object: np.ndarray | None
    covariance: np.ndarray | None
    reason: Reason | None = None
    camera_origin: CameraOrigin = CameraOrigin.CALIBRATED
    in_flight: int
    admitted: int
    finished: int
    dropped_at_the_door: int
    lost: int
    level: int = 0
    _arrays: ClassVar = {"cam_from_object": POSE, "covariance": COVARIANCE}

    @property
    def is_sure(self) -> bool:
        """Whether its pose was measured, in this very frame, and tracking is sure of it."""
        return self.cam_from_object is not None and self.score > 0 and self.state is TrackingState.TRACKING


class Control(Message, kw_only=True):
    """What tracking was asked for from outside, and has done, at the header's capture time.

    after_frame: the newest frame that had come by then; None before the first. cam_from_object: the guess that was set;
    solves_per_s: how often frames are solved at least from here on.
    """

    request: Changes
    after_frame: int | None
    cam_from_object: np.ndarray | None
    solves_per_s: float | None
    _arrays: ClassVar = {"cam_from_object": POSE}


class Stats(Message, kw_only=True):
    """Counters of one process since it started; sent from its main loop, so that it is the heartbeat as well.

    `refused` are payloads that were no message, and requests that were not carried out. `gaps` are messages that should
    have come and did not; `skipped` those that a newest-only input let go.
    `busy_s` is what all calls that answered took, `busy_ms_` what the newest of them did.
    """

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
    cpu_s: float
    rss_mb: float
    busy_s: float = 0.0
