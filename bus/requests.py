"""What can be asked of a running stage, and what it answers: msgpack maps, as messages on topics are.

A request names its kind under `request`, and the version of what can be asked: {"request": "reset", "version": 1}.
Each kind has one type of answer; `ControlValues` is that of what is asked of tracking, `SnapshotSaved` the recorder's.
"""

from __future__ import annotations

from typing import Any, ClassVar, Generic, TypeVar, cast

import numpy as np

from fieldpose.bus.codec import converted, decode, unpacked
from fieldpose.bus.messages import POSE, Checked, TrackingState
from fieldpose.errors import CodecError
from fieldpose.stages.geometry import RIGID_TOLERANCE, is_rigid

VERSION = 1
MAX_BYTES = 4 << 10
MAX_ANSWER_BYTES = 8 << 10
MOST_SOLVES_PER_S = 100.0
MOST_SNAPSHOT_S = 600.0


class Response(Checked, kw_only=True):
    """Base of all answers."""

    version: int = VERSION


R = TypeVar("R", bound=Response)


class ControlValues(Response, kw_only=True):
    """How things are once a request is carried out.

    state: of the newest frame, INITIALIZING before the first and after a reset. frames: how many have come; requests:
    how many that change something were carried out. solves_per_s: how often a frame is solved at least, at most 100;
    None where frames are not followed. begins_at: (4, 4) where tracking begins when nothing is known of the camera;
    None where training views are tried, and where frames stand each by itself. keyframes: of how many frames the
    view was kept because that was asked for, of which the newest eight are there; None where frames are not followed.
    """

    state: TrackingState
    frames: int
    requests: int
    solves_per_s: float | None
    begins_at: np.ndarray | None
    keyframes: int | None = None
    _arrays: ClassVar = {"begins_at": POSE}


class SnapshotSaved(Response, kw_only=True):
    """A recording of what came last, whole and in its place. path: of the file, on the recorder's host.

    seconds: how much it holds, less than was asked for where not so much was kept; messages: how many.
    """

    path: str
    seconds: float
    messages: int


class Request(Checked, Generic[R], kw_only=True, tag_field="request"):
    """Base of all requests, generic in what answers them."""

    version: int = VERSION
    answer_type: ClassVar[type[Response]] = ControlValues

    @property
    def kind(self) -> str:
        """Its name on the wire."""
        return str(self.__struct_config__.tag)


class Reset(Request[ControlValues], kw_only=True, tag="reset"):
    """Forget what is believed of the camera, and begin again as this run has begun."""


class SetGuess(Request[ControlValues], kw_only=True, tag="set_guess"):
    """Forget what is believed, and begin again at this rigid cam_from_object (4, 4), in OpenCV axes."""

    cam_from_object: np.ndarray
    _arrays: ClassVar = {"cam_from_object": POSE}

    def __post_init__(self) -> None:
        super().__post_init__()
        if not is_rigid(self.cam_from_object, RIGID_TOLERANCE):
            raise ValueError(
                "cam_from_object: no rigid transform; expected a rotation and a translation by rows, then 0 0 0 1"
            )


class SetSolving(Request[ControlValues], kw_only=True, tag="set_solving"):
    """Solve a frame at least so often a second; 0: only where following needs it. At most 100."""

    solves_per_s: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.solves_per_s <= MOST_SOLVES_PER_S:
            raise ValueError(f"solves_per_s: {self.solves_per_s:g} where 0 to {MOST_SOLVES_PER_S:g} is expected")


class TakeKeyframe(Request[ControlValues], kw_only=True, tag="take_keyframe"):
    """Solve the newest frame, or the next that is followed well, from where it was; keep its view if that is right."""


class Show(Request[ControlValues], kw_only=True, tag="show"):
    """Change nothing, and say how things are."""


class SaveSnapshot(Request[SnapshotSaved], kw_only=True, tag="save_snapshot"):
    """Write what came in the last seconds, above 0 and at most 600, as a recording; asked of the recorder."""

    seconds: float
    answer_type: ClassVar[type[Response]] = SnapshotSaved

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.seconds <= MOST_SNAPSHOT_S:
            raise ValueError(
                f"seconds: {self.seconds:g} where a number above 0, at most {MOST_SNAPSHOT_S:g}, is expected"
            )


KINDS: dict[str, type[Request[Any]]] = {
    "reset": Reset, "set_guess": SetGuess, "set_solving": SetSolving, "take_keyframe": TakeKeyframe, "show": Show,
    "save_snapshot": SaveSnapshot,
}  # fmt: skip


def decode_request(payload: bytes) -> Request[Any]:
    """Unpack and check a request. Raises CodecError for anything that is not exactly one valid request."""
    fields = unpacked(payload, "request", MAX_BYTES)
    if not isinstance(fields, dict):
        raise CodecError("request: no map; expected one of its fields, as {request: reset, version: 1}")
    kind, version = fields.get("request"), fields.get("version")
    if type(version) is not int or version != VERSION:
        raise CodecError(f"request: version {_shown(version)} where {VERSION} is expected; ask with the same fieldpose")
    if not isinstance(kind, str) or kind not in KINDS:
        raise CodecError(f"request: {_shown(kind)} where one of {', '.join(KINDS)} is expected")
    return converted(fields, KINDS[kind])


def decode_answer(payload: bytes, request: Request[R]) -> R:
    """Unpack and check what answers a request. Raises CodecError."""
    return cast(R, decode(payload, request.answer_type, MAX_ANSWER_BYTES))


def _shown(value: object) -> str:
    return ascii(value)[:40] if isinstance(value, str | int | float | None) else f"a {type(value).__name__}"
