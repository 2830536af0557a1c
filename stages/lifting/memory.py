"""What is known of the consistency of pixels of views that come again."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from cachetools import LRUCache

_VIEWS = 128

Look = Callable[[np.ndarray], np.ndarray]
Remember = Callable[[np.ndarray, Look], np.ndarray]


class ConsistencyMemory:
    """The paper's m of pixels of the last views, by view_id: a pixel is looked at from nearby views only once.

    Keypoints of a view are the same each time that it is matched, so that a view that is used again costs little.
    """

    def __init__(self, views: int = _VIEWS) -> None:
        self._views: LRUCache[str, dict[int, float]] = LRUCache(views)

    def of(self, view_id: str) -> Remember:
        """Gives m (n,) float32 at pixels (n, 2) of a view; `look` at the indices (k,) of those that are not known."""
        return partial(self._get, view_id)

    def _get(self, view_id: str, pixels: np.ndarray, look: Look) -> np.ndarray:
        known = self._views.get(view_id, {})
        keys = np.ascontiguousarray(pixels, np.float32).view(np.int64)[:, 0].tolist()
        new = {key: i for i, key in enumerate(keys) if key not in known}
        if new:
            known.update(zip(new, look(np.array(list(new.values()))).tolist(), strict=True))
        if self._views.maxsize > 0:
            self._views[view_id] = known
        return np.array([known[key] for key in keys], np.float32)
