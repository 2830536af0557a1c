"""Which points of which views are looked for in a frame: those of the nearest views, spread over the frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fieldpose.stages.alignment.images import FramePyramid
from fieldpose.stages.alignment.placing import Placed, Warped, place, warped
from fieldpose.stages.alignment.views import ViewPoints
from fieldpose.stages.geometry import viewing_angles
from fieldpose.stages.geometry.arrays import Flags, Matrices2, Pixels64, Points64, Transform

_CELLS = 8
"""Along the frame's longer side."""
_EXACT = 0.1
"""Radians between the directions of view at which what a field's depth is off counts as much as what a patch is: points
of a view that saw them from further round count less. Of 0.03 to 0.2: with a poor field, a hand-held video's poses
tremble a tenth to a quarter less, with good ones they are as they were."""


@dataclass(frozen=True)
class Found:
    """What was found in the frame: pixels (n, 2) as the camera distorts them and without that, points (n, 3), weights.

    expected: (n, 2) where the pose had put them.
    """

    pixels: Pixels64
    undistorted: Pixels64
    expected: Pixels64
    points: Points64
    weights: Matrices2

    def __len__(self) -> int:
        return len(self.pixels)


@dataclass(frozen=True)
class Chosen:
    """Points of several views: pairs of a view and which of its points, the most wanted first."""

    parts: Sequence[tuple[ViewPoints, np.ndarray]]

    def __len__(self) -> int:
        return sum(len(index) for _, index in self.parts)

    def limited(self, most: int) -> Chosen:
        """About so many of the points, of each view its share."""
        share = min(1.0, most / max(len(self), 1))
        return Chosen([(view, index[: int(np.ceil(share * len(index)))]) for view, index in self.parts])

    def found(self, frame: FramePyramid, pose: Transform, level: int) -> Found:
        """Look for the points near where a pose puts them; patches are 2^level pixels coarse."""
        results = []
        for view, index in self.parts:
            at = warped(view, frame, pose)
            placed = place(view, frame, at, level, index[at.seen[index]])
            angles = viewing_angles(view.points[placed.index], view.cam_from_object, pose)
            exact = 1 / (1 + (angles / _EXACT) ** 2)
            results.append((view, at, replace(placed, weights=placed.weights * exact[:, None, None])))
        return _gathered(results, frame)

    def in_frame(self, frame: FramePyramid, pose: Transform) -> tuple[Pixels64, Points64]:
        """Where a pose puts those of the points that it puts into the frame, and these points."""
        pixels, points = [np.zeros((0, 2))], [np.zeros((0, 3))]
        for view, index in self.parts:
            at = warped(view, frame, pose)
            seen = index[at.seen[index]]
            pixels.append(at.starts[seen].astype(np.float64))
            points.append(view.points[seen])
        return np.concatenate(pixels), np.concatenate(points)

    def shift(self, frame: FramePyramid, first: Transform, second: Transform) -> float:
        """By how many pixels, in the median, two poses put the points apart; infinite where one of them shows none."""
        shifts = [np.zeros(0)]
        for view, index in self.parts:
            before, after = warped(view, frame, first), warped(view, frame, second)
            both = index[before.seen[index] & after.seen[index]]
            shifts.append(np.linalg.norm(before.starts[both] - after.starts[both], axis=1))
        known = np.concatenate(shifts)
        return float(np.median(known)) if len(known) else np.inf

    def angle(self, pose: Transform) -> float:
        """The typical angle, in radians, between the directions in which views and a pose see the points."""
        angles = [viewing_angles(view.points[index], view.cam_from_object, pose) for view, index in self.parts]
        return float(np.median(np.concatenate(angles)))


def chosen_points(views: Sequence[tuple[ViewPoints, Warped]], frame: FramePyramid, most: int) -> Chosen:
    """At most so many points, spread over the frame; in each part of it those of the first views come first."""
    indices = [np.flatnonzero(at.seen) for _, at in views]
    owner = np.repeat(np.arange(len(views)), [len(index) for index in indices])
    if len(owner) == 0:
        return Chosen([])
    index = np.concatenate(indices)
    places = np.concatenate([at.starts[own] for (_, at), own in zip(views, indices, strict=True)])
    cells = np.floor(places * (_CELLS / max(frame.camera.width, frame.camera.height))).astype(int) @ (1, 1000)
    # Within a cell they come as they are: by view, and in a view by texture.
    order = np.argsort(cells, kind="stable")
    sorted_cells = cells[order]
    starts = np.flatnonzero(np.r_[True, sorted_cells[1:] != sorted_cells[:-1]])
    rank = np.empty(len(order), int)
    rank[order] = np.arange(len(order)) - np.repeat(starts, np.diff(np.r_[starts, len(order)]))
    wanted = np.argsort(rank, kind="stable")[:most]
    return Chosen([(view, index[wanted[owner[wanted] == i]]) for i, (view, _) in enumerate(views)])


def _gathered(results: Sequence[tuple[ViewPoints, Warped, Placed]], frame: FramePyramid) -> Found:
    pixels = np.concatenate([np.zeros((0, 2)), *(placed.pixels for _, _, placed in results)])
    undistorted, usable = frame.camera.without_distortion(pixels)
    expected = np.concatenate([np.zeros((0, 2)), *(at.starts[placed.index] for _, at, placed in results)])
    points = np.concatenate([np.zeros((0, 3)), *(view.points[placed.index] for view, _, placed in results)])
    weights = np.concatenate([np.zeros((0, 2, 2)), *(placed.weights for _, _, placed in results)])
    return Found(pixels[usable], undistorted[usable], expected[usable], points[usable], weights[usable])


def is_found(found: Found, wanted: Points64, agreeing: Flags) -> Flags:
    """Which of the wanted points (n, 3) are among those that were found and agree."""
    known = {point.tobytes() for point in found.points[agreeing]}
    return np.array([point.tobytes() in known for point in wanted], bool)
