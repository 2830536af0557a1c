"""What a pipeline says of each frame, put together to be looked at; from a bus or from a recording."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from fieldpose.bus.messages import (
    CameraInfo,
    Correspondences,
    Followed,
    Frame,
    Header,
    Message,
    State,
    TrackingState,
)
from fieldpose.bus.topics import CAMERA_INFO, CORRESPONDENCES, FOLLOWED, FRAME, STATE
from fieldpose.deploy.reporting.reasons import reason_in_words
from fieldpose.stages.geometry import Camera, camera_centre

WATCHED = (FRAME, CAMERA_INFO, STATE, FOLLOWED, CORRESPONDENCES)
_KEPT, _IMAGES = 256, 8
_WAY = 5000
_FEW = 0.5
"""Of the points that were looked for."""


@dataclass(frozen=True)
class Moment:
    """One frame: its image where that has come, and what was said of it.

    lifted: the points of the newest solve; solving: whether a pose was guessed for it, to be solved.
    """

    frame_id: int
    capture_ns: int
    frame: Frame | None = None
    camera: Camera | None = None
    sent_ns: int | None = None
    state: State | None = None
    followed: Followed | None = None
    lifted: Correspondences | None = None
    solving: bool = False

    @property
    def latency_ms(self) -> float | None:
        """From the sending of the frame to that of its state."""
        if self.sent_ns is None or self.state is None:
            return None
        return (self.state.header.sent_ns - self.sent_ns) / 1e6

    @property
    def pose(self) -> np.ndarray | None:
        """cam_from_object (4, 4) as measured; None where nothing was."""
        return None if self.state is None or self.state.score <= 0 else self.state.cam_from_object

    @property
    def place(self) -> tuple[np.ndarray, TrackingState] | None:
        """Where the camera was (3,), and how sure tracking was of it."""
        return None if self.pose is None or self.state is None else (camera_centre(self.pose), self.state.state)

    def with_image(self, frame: Frame | None, lifted: Correspondences | None) -> Moment:
        """With its image, and the points of the newest solve."""
        return replace(self, frame=frame, lifted=self.lifted or lifted)


class Moments:
    """The newest frames of one pipeline, and the way of its camera. kept: how many frames, None for all."""

    def __init__(self, kept: int | None = _KEPT) -> None:
        self._kept = kept
        self._moments: OrderedDict[tuple[int, int], Moment] = OrderedDict()
        self._lifted: Correspondences | None = None
        self._numbers: dict[str, int] = {}
        self.way: list[tuple[np.ndarray, TrackingState]] = []

    def note(self, message: Message) -> None:
        """Take in one of the topics WATCHED. A camera that begins again may number its frames as it did before."""
        if isinstance(message, CameraInfo | State) and self._began_again(message):
            self._moments.clear() if isinstance(message, CameraInfo) else self.way.clear()
        match message:
            case Frame():
                self._set(message.header, frame=message, camera=message.camera, sent_ns=message.header.sent_ns)
            case CameraInfo():
                known = self._moments.get(message.header.frame_key)
                sent_ns = known.sent_ns if known is not None and known.sent_ns is not None else message.header.sent_ns
                self._set(message.header, camera=message.camera, sent_ns=sent_ns)
            case Followed():
                self._set(message.header, followed=message)
            case Correspondences():
                self._lifted = message
                self._set(message.header, lifted=message)
            case State():
                known = self._set(message.header, state=message)
                if known.place is not None:
                    self.way.append(known.place)
                    del self.way[:-_WAY]

    def note_solving(self, header: Header) -> None:
        """Take in that a frame is being solved, so that its image is shown with what comes of it."""
        if header.frame_key in self._moments:
            self._set(header, solving=True)

    def newest(self, with_image: bool = True) -> Moment | None:
        """The newest frame that there is a state of, and an image; with the points of the newest solve."""
        for moment in reversed(self._moments.values()):
            if moment.state is not None and (moment.frame is not None or not with_image):
                return moment.with_image(moment.frame, self._lifted)
        return None

    def answered(self) -> Iterator[Moment]:
        """Those of the newest frames that there is a state of, oldest first."""
        return (moment for moment in self._moments.values() if moment.state is not None)

    def _let_images_go(self) -> None:
        """Of all frames but the newest, and but for those that are being solved, the newest of them."""
        held = [(key, moment) for key, moment in self._moments.items() if moment.frame is not None]
        solving = [key for key, moment in held if moment.solving and moment.state is None][-_IMAGES:]
        for key, _ in held[:-_IMAGES]:
            if key not in solving:
                self._moments[key] = replace(self._moments[key], frame=None)

    def _began_again(self, message: Message) -> bool:
        """Whether the sender of a topic counts from 0 again."""
        kind, number = type(message).__name__, message.header.sequence
        before, self._numbers[kind] = self._numbers.get(kind, -1), number
        return number < before

    def _set(self, header: Header, **known: object) -> Moment:
        key = header.frame_key
        before = self._moments.get(key) or Moment(header.frame_id, header.capture_ns)
        self._moments[key] = replace(before, **known)  # type: ignore[arg-type]
        if self._kept is not None and len(self._moments) > self._kept:
            self._moments.popitem(last=False)
        if "frame" in known:
            self._let_images_go()
        return self._moments[key]


def told(moment: Moment) -> str:
    """What became of a frame, for people, and why something is not sure or lost."""
    state = moment.state
    if state is None:
        return "no answer yet"
    words = [str(state.state)]
    if moment.followed is not None:
        found, looked_for = int(moment.followed.found.sum()), len(moment.followed.found)
        words.append(f"{found} of {looked_for} points found")
        if found < _FEW * looked_for:
            words[-1] += ": occluded, blurred, or out of view"
    if state.reason is not None:
        words.append(reason_in_words(state.reason))
    if state.level:
        words.append("following does less than it might, for want of time")
    return "; ".join(words)
