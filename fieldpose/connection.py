"""Taking part in a running pipeline: listening to its states, sending it frames and guesses, resetting it."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType

import numpy as np

from fieldpose.bus.control import ask_one
from fieldpose.bus.messages import CameraOrigin, Encoding, Prior, State
from fieldpose.bus.ports import Inbox, Outbox, first_header
from fieldpose.bus.requests import ControlValues, Request, Reset, SetGuess, SetSolving, Show, TakeKeyframe
from fieldpose.bus.topics import PRIOR, STATE, Address
from fieldpose.bus.transport import LOCAL_HUB, Closing, wait_for
from fieldpose.deploy.access.joining import NO_ENTRY, Entry, join
from fieldpose.deploy.access.roles import PROGRAM
from fieldpose.errors import ConfigError, GeometryError, TransportError
from fieldpose.stages.camera.wire import frame_messages
from fieldpose.stages.geometry import RIGID_TOLERANCE, Camera, is_rigid
from fieldpose.stages.images import checked_image

_POLL_S = 0.1
_KEPT_STATES = 1024
_MEETING_S = 3.0
"""Tracking is waited for so long, and may come later."""


class Connection:
    """One pipeline, an (object, camera) pair at a site, on the bus of a hub. Raises FieldposeError without a hub.

    entry: by what it is let in; roles: in the first of which there are keys of.
    """

    def __init__(
        self, hub: str, address: Address, timeout_s: float, entry: Entry = NO_ENTRY, roles: Sequence[str] = (PROGRAM,)
    ) -> None:
        self._bus, self._address = join(hub, entry, roles, timeout_s, coming_s=0.0), address
        try:
            self._states = Inbox(self._bus, address, (STATE,), {STATE: _KEPT_STATES})
            # The hub answers before there is a link to anybody else, without which the first frame would be lost.
            with suppress(TransportError):
                wait_for(self._bus, address, ["tracking"], min(timeout_s, _MEETING_S))
            self._bus.settle(timeout_s, images=True)
        except BaseException:
            self._bus.close()
            raise
        self._outbox = Outbox(self._bus, address, "camera")
        self._announced: Closing | None = None
        self._frames = 0

    def states(self, timeout_s: float | None = None) -> Iterator[State]:
        """What tracking says of each frame, as it comes; ends where nothing has come for `timeout_s`.

        The newest 1024 wait for a slow reader. A state whose score is 0 was not measured.
        """
        heard_at = time.monotonic()
        while timeout_s is None or time.monotonic() - heard_at < timeout_s:
            received = self._states.get(_POLL_S)
            if received is not None and isinstance(received.message, State):
                yield received.message
                heard_at = time.monotonic()

    def publish(
        self, image: np.ndarray, camera: Camera, capture_ns: int | None = None,
        encoding: Encoding = "rgb8", frame_id: int | None = None,
    ) -> int:  # fmt: skip
        """Send a frame: (h, w, 3) uint8 RGB, or the bytes (n,) uint8 of a jpeg or png file. Returns its number.

        camera: of this image. capture_ns: when it was taken, since the epoch (default: now); motion is judged by it.
        The first makes itself known on the bus, and waits for the answers of others, some milliseconds, at most 3 s.
        """
        if encoding == "rgb8":
            checked_image(image)
        if self._announced is None:
            self._announced = self._outbox.announce()
            # Who has not heard of it yet would take the frame for a stranger's.
            self._bus.settle(_MEETING_S)
        frame_id = self._frames if frame_id is None else frame_id
        self._frames = frame_id + 1
        header = first_header(frame_id, time.time_ns() if capture_ns is None else capture_ns)
        for topic, message in frame_messages(header, image, encoding, camera, CameraOrigin.CALIBRATED):
            self._outbox.publish(topic, message)
        return frame_id

    def publish_prior(self, frame_id: int, cam_from_object: np.ndarray) -> None:
        """Send a guess of a frame's pose (4, 4), from a robot arm's kinematics for instance, before that frame."""
        pose = np.array(cam_from_object, np.float64)
        if not is_rigid(pose, RIGID_TOLERANCE):
            raise GeometryError(f"a prior must be a rigid (4, 4) cam_from_object, got {pose.tolist()}")
        self._outbox.publish(PRIOR, Prior(header=first_header(frame_id, time.time_ns()), cam_from_object=pose))

    def values(self, timeout_s: float = 5.0) -> ControlValues:
        """How tracking is. Raises FieldposeError where it does not answer in time."""
        return self._ask(Show(), timeout_s)

    def reset(self, cam_from_object: np.ndarray | None = None, timeout_s: float = 5.0) -> ControlValues:
        """Have tracking forget what it believes; the next frame begins at this guess (4, 4), or as the first did.

        Raises FieldposeError for what is no rigid transform, where frames stand each by itself, or without an answer.
        """
        if cam_from_object is None:
            return self._ask(Reset(), timeout_s)
        pose = np.array(cam_from_object, np.float64)
        if not is_rigid(pose, RIGID_TOLERANCE):
            raise GeometryError(f"a guess must be a rigid (4, 4) cam_from_object, got {pose.tolist()}")
        return self._ask(SetGuess(cam_from_object=pose), timeout_s)

    def set_solving(self, per_second: float, timeout_s: float = 5.0) -> ControlValues:
        """Have a frame solved at least so often, 0 to 100 times a second; 0: only where following needs it.

        Raises FieldposeError for other numbers, where frames are not followed, or without an answer.
        """
        try:
            request = SetSolving(solves_per_s=float(per_second))
        except ValueError as error:
            raise ConfigError(str(error)) from None
        return self._ask(request, timeout_s)

    def take_keyframe(self, timeout_s: float = 5.0) -> ControlValues:
        """Have the next frame that is followed well solved at once, and its view kept if the solve bears that out.

        The answer comes before; `values().keyframes` grows once it is kept, as the newest eight are. Raises
        FieldposeError where the camera is not tracked, where frames are not followed, or without an answer.
        """
        return self._ask(TakeKeyframe(), timeout_s)

    def _ask(self, request: Request[ControlValues], timeout_s: float) -> ControlValues:
        return ask_one(self._bus, self._address, "tracking", request, timeout_s)

    def close(self) -> None:
        """Leave the bus."""
        self._states.close()
        self._bus.close()

    def __enter__(self) -> Connection:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def connect(
    hub: str = LOCAL_HUB, object: str = "object", camera: str = "camera0", site: str = "fieldpose",
    timeout_s: float = 10.0, tls: str | Path | None = None, role: str = PROGRAM, open: bool = False,
) -> Connection:  # fmt: skip
    """Join the bus of a pipeline whose hub listens at `hub` (`fieldpose run … --listen`, or `fieldpose stage hub`).

    A run of this user on this machine needs no more. tls: the folder of certificates of `fieldpose certs`, of which
    that of `role` is taken: program (all that a Connection can do), camera (only `publish`), prior (only
    `publish_prior`), operator (only requests) or viewer. open: of a hub that lets everybody in.

    Raises FieldposeError where no hub answers within `timeout_s`, or where it refuses, and why.
    """
    entry = Entry(None if tls is None else Path(tls), open)
    return Connection(hub, Address(site, object, camera), timeout_s, entry, (role,))
