"""Which cells may hold something, and which are to be looked at again though they seem to be empty.

A cell that is judged empty is marched through no more, so nothing can be learnt there. What makes it worth another look
is told by the images: that all silhouettes hold it, or that most views which see it are wrong there.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fieldpose.stages.nerf.blocks import Blocks, View
from fieldpose.stages.nerf.hull import Marked, hull
from fieldpose.stages.nerf.metadata import Space

OPAQUE = 2
"""Least alpha, of 255, of a pixel that shows something."""
SURE, POSSIBLE = 0.03, 0.25
"""Share of the views that may contradict a cell which is looked at from the start, or held to be possible at all: masks
have gaps, and poses errors."""
MISSED, MISSED_BY = 0.3, 3
"""Share of the views that may be right where something is missing; how many at least are to see it."""
LEAST_ERROR = 0.01
"""Squared error, its three channels summed, that is not worth a look: 25 dB."""
WORSE = 3.0
"""How many times the mean error is."""
MOST = 0.02
"""Share of the empty cells that may be looked at again at once: with half of a room's, haze came back and stayed."""
HIGHER = 1.4
"""By how much an error is to be larger where that many cells are too many; of twice, a room's wires were lost."""
ASKED = 48
"""So many views, at most, are asked each time, others the next: a look then takes a second or two."""
EARLY, EARLY_EVERY, EVERY = 2048, 512, 1024
UNTIL = 0.9


def silhouettes(views: Sequence[View]) -> list[Marked]:
    """What each image shows of the object; none for opaque images."""
    if views[0].image.shape[2] != 4:
        return []
    return [Marked(v.image[..., 3] >= OPAQUE, v.camera, v.cam_from_object) for v in views]


def due(step: int, fraction: float) -> bool:
    """Whether to look for what is missing, before a step at a `fraction` 0..1 of the training."""
    return step > 0 and step % (EARLY_EVERY if step <= EARLY else EVERY) == 0 and fraction < UNTIL


def missing(blocks: Blocks, space: Space, empty: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Flat cells of `empty`, (n, n, n) bool, that most of the views which see them are wrong at; some are asked."""
    limit = max(LEAST_ERROR, WORSE * blocks.mean_error)
    asked = np.sort(rng.permutation(blocks.views)[:ASKED])
    most = MOST * empty.sum()
    while True:
        found = np.flatnonzero(hull(blocks.wrong(limit, asked), space, empty, MISSED, MISSED_BY))
        if len(found) <= most:
            return found
        limit *= HIGHER
