"""Guesses of frames' poses that come from outside: used where they have come, or waited for."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping

import numpy as np

_KEPT = 256


class Priors:
    """cam_from_object (4, 4) by frame_id; `given` ones stay, of others the newest are kept.

    awaited: no frame is to begin without its prior.
    """

    def __init__(self, awaited: bool = False, given: Mapping[int, np.ndarray] | None = None) -> None:
        self.awaited = awaited
        self._given = dict(given or {})
        self._come: OrderedDict[int, np.ndarray] = OrderedDict()

    def add(self, frame_id: int, cam_from_object: np.ndarray) -> None:
        """Take in what has come for a frame; the longest known is forgotten."""
        self._come[frame_id] = cam_from_object
        while len(self._come) > _KEPT:
            self._come.popitem(last=False)

    def peek(self, frame_id: int) -> np.ndarray | None:
        """That of a frame, left for `take`; None where none has come (yet)."""
        return self._come.get(frame_id, self._given.get(frame_id))

    def take(self, frame_id: int) -> np.ndarray | None:
        """That of a frame; None where none has come (yet). What has come is for one frame, and used once."""
        return self._come.pop(frame_id, self._given.get(frame_id))
