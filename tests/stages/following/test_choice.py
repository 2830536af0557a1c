"""Points of several views in one frame: what each counts."""

from __future__ import annotations

import numpy as np
from support.followed import VIEW, VIEWPOINTS, grey_and_depth, photograph, pyramid_of

from fieldpose.stages.alignment.landmarks import landmarks
from fieldpose.stages.alignment.placing import place, warped
from fieldpose.stages.alignment.views import ViewPoints
from fieldpose.stages.following.choice import Chosen
from fieldpose.stages.following.config import LEVELS
from fieldpose.stages.geometry import viewing_angles


def points_of(pose: np.ndarray) -> ViewPoints:
    grey, depth = grey_and_depth(pose)
    return ViewPoints.of(grey, depth, VIEW, pose, landmarks(grey, depth, VIEW, pose, 100), LEVELS)


def test_what_a_view_saw_from_further_round_counts_less_by_how_much_further() -> None:
    here, there = VIEWPOINTS[0], VIEWPOINTS[1]
    frame = pyramid_of(photograph(here))
    shares = []
    for pose in (here, there):
        view = points_of(pose)
        index = np.arange(len(view.points))
        found = Chosen([(view, index)]).found(frame, here, 0)
        placed = place(view, frame, warped(view, frame, here), 0, index[warped(view, frame, here).seen])
        angles = viewing_angles(view.points[placed.index], pose, here)
        share = found.weights[:, 0, 0] / placed.weights[:, 0, 0]
        np.testing.assert_allclose(share, 1 / (1 + (angles / 0.1) ** 2), rtol=1e-6)
        shares.append(float(np.median(share)))
    assert shares[0] > 0.99
    assert shares[1] < 0.6
