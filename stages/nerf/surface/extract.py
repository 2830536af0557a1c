"""A field's surface: seen by its training views, put together, cleaned and coloured.

All lengths are in the field's unit, all coordinates the object's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fieldpose.errors import ConfigError
from fieldpose.stages.nerf.metadata import FieldMetadata, Space
from fieldpose.stages.nerf.normalise import object_points
from fieldpose.stages.nerf.rendering_api import RayRenderer
from fieldpose.stages.nerf.surface.fusion import fused, grid_over
from fieldpose.stages.nerf.surface.kernels import DepthViews
from fieldpose.stages.nerf.surface.mesh import (
    SurfaceMesh,
    SurfacePoints,
    pieces_of_share,
    vertex_normals,
    without_unused,
)
from fieldpose.stages.nerf.surface.thinning import one_a_cube, thinned
from fieldpose.stages.nerf.surface.views import agreement, depth_views, seen_by, training_poses

_AGREE = 1.5
"""Cells by which a view may see a surface elsewhere."""


@dataclass(frozen=True)
class Region:
    """Where surface is wanted: a box (2, 3), the lowest and the highest corner; of that the ball within where `ball`.

    exact: leave out what is outside; else the box only tells where to look, and what lies on its sides is kept.
    """

    box: np.ndarray
    ball: bool = False
    exact: bool = True

    @property
    def longest(self) -> float:
        """Its longest side."""
        return float((self.box[1] - self.box[0]).max())

    def holds(self, points: np.ndarray) -> np.ndarray:
        """(n,) bool: which of points (n, 3) are wanted."""
        middle, half = self.box.mean(axis=0), (self.box[1] - self.box[0]) / 2
        if self.ball:
            return np.asarray(np.linalg.norm((points - middle) / half, axis=1) <= 1)
        return np.asarray((np.abs(points - middle) <= half).all(axis=1) if self.exact else np.ones(len(points), bool))


def region_of(space: Space) -> Region:
    """The box that a field is in, or the one around it where it is turned; else the ball that it has at full
    resolution."""
    corners, middle = space.corners, np.array(space.centre)
    if corners is None:
        return Region(np.stack([middle - space.scale, middle + space.scale]), ball=True)
    middle = object_points(space, corners.mean(axis=0))
    half = np.abs(space.turn.T) @ (corners[1] - corners[0]) / 2 * space.scale
    return Region(np.stack([middle - half, middle + half]), exact=False)


def seen_surface(renderer: RayRenderer, metadata: FieldMetadata) -> DepthViews:
    """The training views from which the rest is made. Raises ConfigError where the field tells of none."""
    if not metadata.cameras:
        raise ConfigError("the field does not tell its training views, from which its surface would be made")
    return depth_views(renderer, training_poses(metadata.cameras), metadata.background)


def surface_mesh(
    views: DepthViews, region: Region, resolution: int, least_share: float, threads: int = 1
) -> SurfaceMesh:
    """The surface as a mesh, of cells so small that `resolution` are along the region's longest side.

    least_share: pieces with less of the largest one's area are left out. It is open where no view has looked, and has
    no triangles where none sees anything.
    """
    grid = grid_over(region.box, resolution)
    vertices, triangles = fused(views, grid, threads)
    normals = vertex_normals(vertices, triangles)
    said = agreement(views, vertices, normals, _AGREE * grid.cell, threads)
    triangles = triangles[(said.agreed & region.holds(vertices))[triangles].all(axis=1)]
    triangles = triangles[pieces_of_share(vertices, triangles, least_share)]
    used, triangles = without_unused(triangles, len(vertices))
    return SurfaceMesh(vertices[used].astype(np.float32), normals[used], said.colours[used], triangles)


def surface_points(
    views: DepthViews, region: Region, spacing: float, count: int | None = None, threads: int = 1
) -> SurfacePoints:
    """The surface as points, one in each cube of a side of `spacing` that it passes through.

    count: only so many, spread evenly. Points between what is before and behind an outline are left out: other views
    see past them.
    """
    seen = (seen_by(views, v) for v in range(len(views.depth)))
    means = one_a_cube(((s.points, s.normals, s.facing**2) for s in seen), spacing)
    means = means[region.holds(means[:, :3])]
    length = np.linalg.norm(means[:, 3:], axis=1, keepdims=True)
    means, length = means[length[:, 0] > 0], length[length[:, 0] > 0]
    normals = means[:, 3:] / length
    said = agreement(views, means[:, :3], normals, _AGREE * spacing, threads)
    whole = SurfacePoints(means[:, :3].astype(np.float32), normals.astype(np.float32), said.colours).kept(said.agreed)
    rng = np.random.default_rng(0)
    return whole if count is None else whole.kept(thinned(whole.points, count, spacing, rng))
