"""The frames of a recording, each read when it is asked for."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import cast

import numpy as np

from fieldpose.bus.messages import Frame, TrackingState
from fieldpose.bus.replay import read_recording, recorded_at
from fieldpose.bus.topics import FRAME
from fieldpose.deploy.reporting.gathering import recorded_pipeline
from fieldpose.deploy.viewing.moments import WATCHED, Moment, Moments
from fieldpose.errors import RecordingError


class RecordedMoments:
    """The answered frames of a pipeline of a recording, in the order that they were taken.

    Raises RecordingError where it holds none, and UsageError where `pipeline` (OBJECT/CAMERA) is not one of several.
    """

    def __init__(self, path: Path, pipeline: str | None = None) -> None:
        address = recorded_pipeline(path, pipeline)
        moments = Moments(kept=None)
        self._path, self._key = path, address.key(FRAME)
        self._when: dict[tuple[int, int], int] = {}
        for recorded in read_recording(path, WATCHED):
            if not address.covers(recorded.key):
                continue
            if isinstance(recorded.message, Frame):
                self._when[recorded.message.header.frame_key] = recorded.log_time_ns
                continue
            moments.note(recorded.message)
        self.all: Sequence[Moment] = sorted(moments.answered(), key=lambda m: (m.capture_ns, m.frame_id))
        if not self.all:
            raise RecordingError(f"{path}: holds no states of tracking, so nothing to look at")

    def __len__(self) -> int:
        return len(self.all)

    def at(self, index: int) -> Moment:
        """A frame with its image, and the points of the newest solve by then."""
        moment = self.all[index]
        lifted = next((m.lifted for m in reversed(self.all[: index + 1]) if m.lifted is not None), None)
        when = self._when.get((moment.frame_id, moment.capture_ns))
        frame = None
        if when is not None:
            wanted = (moment.frame_id, moment.capture_ns)
            found = (cast(Frame, r.message) for r in recorded_at(self._path, FRAME, self._key, when))
            frame = next((message for message in found if message.header.frame_key == wanted), None)
        return moment.with_image(frame, lifted)

    def way(self, index: int) -> list[tuple[np.ndarray, TrackingState]]:
        """Where the camera was measured to be up to a frame, and how sure tracking was."""
        return [place for moment in self.all[: index + 1] if (place := moment.place) is not None]
