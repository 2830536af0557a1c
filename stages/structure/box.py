"""Where an object is that cameras look at: a box around what stands apart in their midst.

Source: Ester and others, A density-based algorithm for discovering clusters (1996), with the distance taken from how
densely points lie where the cameras look.
"""

from __future__ import annotations

import numpy as np

from fieldpose.stages.geometry import nearest_point_to_axes
from fieldpose.stages.geometry.arrays import Flags, Points64, Transforms
from fieldpose.stages.structure.upright import distance_of_focus, plane_under

REACH = 0.6
"""Of the distance of the cameras from what they look at: an object is within."""
_FOCUS = 0.2
"""Of that distance: how far from there points count for what the cameras look at."""
_NEIGHBOURS = 8
_DENSE = 2.0
"""Times the distance to so many neighbours that points have in the median where the cameras look: nearer ones are of
one thing. On a can, a robot and a fox 1.5 took parts off, and 3 joined what stands beside."""
_TRIMMED = 0.5
"""Percent of the points at each end of an axis."""
_MARGIN = 0.04
"""Of the box's longest side, on each of its sides: where points of the surface are found, it does not end."""
_LIFTED = 0.02
"""Of the distance of the cameras: so thick is what lies on the plane, below which the object is not looked for."""
_FEWEST = 50
_AT_THE_EDGE = 0.02
"""Of its points: so many near the edge of what is within reach, and it is no thing that stands apart."""


def object_box(points: Points64, cam_from_object: Transforms) -> np.ndarray | None:
    """The box (2, 3), lowest and highest corner, of what cameras (n, 4, 4) look at; None if nothing stands apart there.

    points (m, 3): what they show of their surroundings. What the object stands on is left out, if it is found to be a
    plane across one of the axes, else it is in the box.
    """
    focus, distance = nearest_point_to_axes(list(cam_from_object)), distance_of_focus(cam_from_object)
    plane = plane_under(cam_from_object, points)
    near = np.linalg.norm(points - focus, axis=1) < REACH * distance
    if plane is not None:
        near &= points @ plane[0] - plane[1] > _LIFTED * distance
    around = points[near]
    if len(around) < _FEWEST:
        return None
    thing = around[_connected(around, focus, distance)]
    at_edge = np.linalg.norm(thing - focus, axis=1) > 0.9 * REACH * distance
    if len(thing) < _FEWEST or at_edge.mean() > _AT_THE_EDGE:
        return None
    low, high = np.percentile(thing, (_TRIMMED, 100 - _TRIMMED), axis=0)
    margin = _MARGIN * float((high - low).max())
    box: np.ndarray = np.stack([low - margin, high + margin])
    if plane is not None:
        _stand(box, *plane)
    return box


def _connected(points: Points64, focus: np.ndarray, distance: float) -> Flags:
    """Which of the points are of the one dense part that has most where the cameras look."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    spacing = tree.query(points, _NEIGHBOURS + 1)[0][:, -1]
    weight = np.exp(-((np.linalg.norm(points - focus, axis=1) / (_FOCUS * distance)) ** 2))
    order = np.argsort(spacing)
    half = np.searchsorted(np.cumsum(weight[order]), weight.sum() / 2)
    reach = _DENSE * spacing[order][half]
    dense = spacing <= reach
    pairs = tree.query_pairs(reach, output_type="ndarray")
    pairs = pairs[dense[pairs].all(axis=1)]
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), (len(points), len(points)))
    label = connected_components(graph, directed=False)[1]
    best = np.bincount(label, weight * dense).argmax()
    found: np.ndarray = (label == best) & dense
    return found


def _stand(box: np.ndarray, normal: np.ndarray, offset: float) -> None:
    """Set a face of the box on the plane, where it is across an axis."""
    axis = int(np.abs(normal).argmax())
    if abs(normal[axis]) < np.cos(np.radians(2)):
        return
    box[0 if normal[axis] > 0 else 1, axis] = offset / normal[axis]
