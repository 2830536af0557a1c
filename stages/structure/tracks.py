"""Points that several photographs show, each as the keypoints that were matched with each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fieldpose.stages.geometry.arrays import Flags, Indices, Pixels64
from fieldpose.stages.structure.features import Keypoints

SHORTEST = 3
"""Images a track is seen in: of two, nothing would tell a wrong match along the epipolar line."""


@dataclass(frozen=True, eq=False)
class Tracks:
    """Observations, sorted by track: its number (0, 1, ... without a gap), the image, and the pixel there, as seen."""

    track: Indices
    image: Indices
    pixels: Pixels64

    @property
    def count(self) -> int:
        """How many tracks there are."""
        return int(self.track[-1]) + 1 if len(self.track) else 0

    def chosen(self, tracks: Flags) -> Tracks:
        """Some of the tracks, flagged one each, numbered anew."""
        kept = tracks[self.track]
        number = np.cumsum(tracks) - 1
        return Tracks(number[self.track[kept]], self.image[kept], self.pixels[kept])

    def seen_by(self, count: int) -> Indices:
        """How many tracks each of `count` images shows."""
        return np.bincount(self.image, minlength=count)

    def seen_in(self, images: Flags) -> Tracks:
        """As the flagged images alone see them, these numbered anew, as are the tracks that they show enough of."""
        seen = self.without(~images[self.image])
        number = np.cumsum(images) - 1
        return Tracks(seen.track, number[seen.image], seen.pixels)

    def without(self, observations: Flags) -> Tracks:
        """All but the flagged observations, and but the tracks that become too short by that, numbered anew."""
        left = np.bincount(self.track[~observations], minlength=self.count)
        kept = ~observations & (left >= SHORTEST)[self.track]
        number = np.cumsum(left >= SHORTEST) - 1
        return Tracks(number[self.track[kept]], self.image[kept], self.pixels[kept])


def join_tracks(
    keypoints: Sequence[Keypoints], pairs: Sequence[tuple[int, int]], matches: Sequence[np.ndarray]
) -> Tracks:
    """Tracks of all matches (n, 2) of pairs of images; left out are those that show one image twice."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    start = np.concatenate([[0], np.cumsum([len(points) for points in keypoints])]).astype(np.int64)
    links = [np.add(found, (start[i], start[j])) for (i, j), found in zip(pairs, matches, strict=True)]
    ends = np.concatenate([*links, np.zeros((0, 2), np.int64)])
    size = int(start[-1])
    graph = coo_matrix((np.ones(len(ends), bool), (ends[:, 0], ends[:, 1])), (size, size))
    _, label = connected_components(graph, directed=False)
    image = np.repeat(np.arange(len(keypoints)), np.diff(start))
    pixels = np.concatenate([points.pixels for points in keypoints]) if keypoints else np.zeros((0, 2))
    order = np.lexsort((image, label))
    label, image, pixels = label[order], image[order], pixels[order]
    twice = np.zeros(size + 1, bool)
    twice[label[1:][(label[1:] == label[:-1]) & (image[1:] == image[:-1])]] = True
    length = np.bincount(label, minlength=size + 1)
    kept = (length >= SHORTEST)[label] & ~twice[label]
    _, number = np.unique(label[kept], return_inverse=True)
    return Tracks(number.astype(np.int64), image[kept], pixels[kept])
