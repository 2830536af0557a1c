"""What retrieval has found: the training views that look like a frame, kept for as long as they may be asked for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from cachetools import FIFOCache

from fieldpose.stages.tracking.policy import FrameInfo

_KEPT = 64

Poses = Sequence[np.ndarray]


class RetrievedPoses:
    """cam_from_object (4, 4) of training views by frame, the most alike first."""

    def __init__(self) -> None:
        self._poses: FIFOCache[tuple[int, int], Poses] = FIFOCache(_KEPT)

    def add(self, frame_id: int, capture_ns: int, poses: Poses) -> None:
        """Take in what was found for a frame, unless that is nothing; the longest known is forgotten."""
        if poses:
            self._poses[frame_id, capture_ns] = poses

    def of(self, frame: FrameInfo) -> Poses:
        """For this frame; nothing where it is not known (yet)."""
        return self._poses.get((frame.frame_id, frame.capture_ns), ())

    def near(self, frame: FrameInfo, within_ns: float) -> Poses:
        """For this frame, else for the newest that was taken so shortly before."""
        found = self.of(frame)
        if found:
            return found
        times = {key: frame.capture_ns - key[1] for key in self._poses}
        recent = [key for key, since_ns in times.items() if 0 <= since_ns <= within_ns]
        return self._poses[min(recent, key=times.__getitem__)] if recent else ()
