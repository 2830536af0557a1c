"""Where to look when nothing is known of the camera: training views, good poses of this run, and in which order."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fieldpose.errors import ConfigError
from fieldpose.stages.geometry import Limit, pairwise
from fieldpose.stages.nerf.training_views import TrainingViews


def farthest_point_order(poses: np.ndarray, limit: Limit) -> list[int]:
    """Indices of poses (n, 4, 4): first the most central, then always the one farthest from those chosen.

    Ends as soon as every pose lies within the limit of a chosen one.
    Source: Gonzalez, Clustering to minimize the maximum intercluster distance (1985).
    """
    if len(poses) == 0:
        return []
    distances = pairwise(poses, poses, limit)
    chosen = [int(distances.mean(axis=1).argmin())]
    nearest = distances[chosen[0]]
    while nearest.max() > 1.0:
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, distances[chosen[-1]])
    return chosen


def nearest_first(poses: np.ndarray, guess: np.ndarray, limit: Limit) -> list[int]:
    """Indices of poses (n, 4, 4) that lie apart from the guess and from each other, the nearest to the guess first."""
    if len(poses) == 0:
        return []
    from_guess, among = pairwise(guess[None], poses, limit)[0], pairwise(poses, poses, limit)
    chosen: list[int] = []
    for i in np.argsort(from_guess, kind="stable"):
        if from_guess[i] > 1.0 and (among[i, chosen] > 1.0).all():
            chosen.append(int(i))
    return chosen


class Keyframes:
    """The newest good poses that lie apart from one another, at most `capacity`."""

    def __init__(self, limit: Limit, capacity: int) -> None:
        self._limit = limit
        self._capacity = capacity
        self._poses: list[np.ndarray] = []

    def __len__(self) -> int:
        return len(self._poses)

    def add(self, cam_from_object: np.ndarray) -> None:
        """Remember a good pose unless one near it is remembered; beyond the capacity the oldest goes."""
        if self._poses and self._distances(cam_from_object).min() <= 1.0:
            return
        self._poses = [*self._poses, cam_from_object][-self._capacity :] if self._capacity else []

    def nearest(self, cam_from_object: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
        """The keyframe nearest to a pose; `otherwise` without any."""
        return self._poses[int(self._distances(cam_from_object).argmin())] if self._poses else otherwise

    def newest(self, count: int) -> list[np.ndarray]:
        """The newest first."""
        return self._poses[-count:][::-1] if count else []

    def _distances(self, cam_from_object: np.ndarray) -> np.ndarray:
        return pairwise(cam_from_object[None], np.stack(self._poses), self._limit)[0]


class Relocaliser:
    """Endless guesses while nothing is known: by turns a pose near where the camera was, and a training view.

    Between them come those that retrieval has named; one that is most alike and was not yet tried comes at once.

    ConfigError if there is no pose at all to try.
    """

    def __init__(self, views: TrainingViews, limit: Limit, near: Sequence[np.ndarray] = ()) -> None:
        order = farthest_point_order(views.cam_from_object, limit)
        self._far = [views.cam_from_object[i] for i in order]
        self.begin(near)
        if self.lap == 0:
            raise ConfigError("tracking has no pose to begin with: give --guess FILE, or a field with training views")

    @property
    def has_found(self) -> bool:
        """Whether the next pose to try is one that was found, so that no other need be looked for."""
        return self._pushed is not None

    @property
    def lap(self) -> int:
        """Guesses until all poses have been tried, without those of retrieval."""
        return len(self._far) + len(self._near)

    def begin(self, near: Sequence[np.ndarray]) -> None:
        """Begin as at the very start, with these poses beside the training views."""
        self.restart(near)
        self._next_far = 0

    def restart(self, near: Sequence[np.ndarray]) -> None:
        """Begin again with these poses, most likely first; the training views go on where they were."""
        self._near = list(near)
        self._pushed: np.ndarray | None = None
        self._turn = self._next_near = 0
        self._tried: set[bytes] = set()
        self._likely_turn = True

    def push(self, cam_from_object: np.ndarray) -> None:
        """Try this pose next, once: it was found, but not confirmed."""
        self._pushed = cam_from_object

    def next(self, likely: Sequence[np.ndarray] = ()) -> np.ndarray:
        """The next pose to try. likely: views that look like the frame, best first."""
        if self._pushed is not None:
            pushed, self._pushed = self._pushed, None
            return pushed
        untried = [pose for pose in likely if pose.tobytes() not in self._tried]
        if untried and (self._likely_turn or untried[0] is likely[0]):
            self._tried.add(untried[0].tobytes())
            self._likely_turn = False
            return untried[0]
        if likely and not untried:
            self._tried.clear()
        self._likely_turn = True
        near_turn = bool(self._near) and (self._turn % 2 == 0 or not self._far)
        self._turn += 1
        if near_turn:
            self._next_near += 1
            return self._near[(self._next_near - 1) % len(self._near)]
        self._next_far += 1
        return self._far[(self._next_far - 1) % len(self._far)]
