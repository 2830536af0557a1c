"""A field's surface as a few thousand points, for finding one's way in it rather than for measuring."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fieldpose.stages.geometry import points_at_depth
from fieldpose.stages.geometry.arrays import Points64
from fieldpose.stages.nerf.framing import SOLID
from fieldpose.stages.nerf.metadata import FieldMetadata
from fieldpose.stages.nerf.rendering_api import RayRenderer

_VIEWS, _LONGER_SIDE = 32, 160
_CELLS = 48
"""In the radius of the field's space; each that surface passes through counts as one point, however near it is seen."""


@dataclass(frozen=True)
class ColouredPoints:
    """points (n, 3) float64 with colours (n, 3) uint8, one in each cube of side `spacing`.

    spread: the median distance of the points from their middle, 1 where there are none.
    """

    points: Points64
    colours: np.ndarray
    spacing: float

    @property
    def spread(self) -> float:
        if not len(self.points):
            return 1.0
        return float(np.median(np.linalg.norm(self.points - np.median(self.points, axis=0), axis=1))) or 1.0


def sampled_surface(renderer: RayRenderer, metadata: FieldMetadata) -> ColouredPoints:
    """Points of a field's surface, evenly spread, where its training views look; in object coordinates."""
    cameras, found, colours = metadata.cameras, [np.empty((0, 3))], [np.empty((0, 3), np.uint8)]
    for view in cameras[:: -(-len(cameras) // _VIEWS) or 1]:
        seen = renderer.render_view(view.camera.undistorted().shrunk(_LONGER_SIDE), view.pose)
        solid = (seen.opacity >= SOLID).ravel()
        pixels, depth = seen.camera.grid()[solid], seen.depth.ravel()[solid]
        found.append(points_at_depth(seen.camera, view.pose, pixels, depth))
        colours.append(seen.rgb.reshape(-1, 3)[solid])
    points, spacing = np.concatenate(found), metadata.space.scale / _CELLS
    _, one_each = np.unique(np.floor(points / spacing), axis=0, return_index=True)
    return ColouredPoints(np.asarray(points[one_each], np.float64), np.concatenate(colours)[one_each], spacing)
