"""How near a mesh of a field is to the true surface, found in two ways: where a dataset knows its depth."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from fieldpose.deploy.benchmarks.machine import cores, describe
from fieldpose.errors import DatasetError
from fieldpose.stages.geometry import points_at_depth
from fieldpose.stages.nerf.datasets import Dataset, load_dataset
from fieldpose.stages.nerf.field import Field, load_field
from fieldpose.stages.nerf.framing import in_dataset_frame
from fieldpose.stages.nerf.kernels.density import densities
from fieldpose.stages.nerf.loading import make_renderer
from fieldpose.stages.nerf.normalise import normalised_points
from fieldpose.stages.nerf.surface.extract import region_of, seen_surface, surface_mesh
from fieldpose.stages.nerf.surface.fusion import BLOCK, grid_over
from fieldpose.stages.nerf.surface.marching import Piece, isosurface, joined
from fieldpose.stages.nerf.surface.mesh import areas
from fieldpose.stages.nerf.surface.views import normals_of
from fieldpose.stages.nerf.workers import Workers

NEAR = 0.003
"""Of the region's longest side: true points that have the mesh so near are complete."""
LEAST_SHARE = 0.001
_SAMPLES, _TRUTHS, _DENSE = 100_000, 40_000, 2_000_000
_LEVELS = (0.3, 0.5, 0.8)
Mesh = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Truth:
    """Points (n, 3) of the true surface with unit normals (n, 3), and the test views' depths that show them."""

    points: np.ndarray
    normals: np.ndarray
    dataset: Dataset
    tree: cKDTree


def measure(path: Path, dataset: Path, resolution: int, report: Callable[[str], None]) -> dict[str, Any]:
    """Both ways on a field of a dataset whose test views have true depth. Raises DatasetError where they have none."""
    field, data = load_field(path), load_dataset(dataset, "test", None)
    field.metadata = in_dataset_frame(field.metadata)
    if any(record.depth_path is None for record in data.images):
        raise DatasetError(f"{dataset}: the test views have no true depth, by which a mesh could be measured")
    truth, region = true_surface(data), region_of(field.metadata.space)
    ways: dict[str, Callable[[], Mesh]] = {"fused depth": partial(_fused, field, resolution)}
    ways |= {f"opacity of a step, {at}": partial(level_set, field, resolution, at) for at in _LEVELS}
    figures: dict[str, Any] = {"machine": describe(), "field": str(path), "resolution": resolution, "ways": {}}
    for name, way in ways.items():
        report(name)
        began = time.monotonic()
        mesh = way()
        seconds = time.monotonic() - began
        parts = {"all": None} | ({} if data.object_aabb is None else {"object": data.object_aabb})
        scores = {part: nearness(mesh, truth, NEAR * region.longest, box) for part, box in parts.items()}
        figures["ways"][name] = {"seconds": seconds, "triangles": len(mesh[1]), **scores}
    return figures


def _fused(field: Field, resolution: int) -> Mesh:
    views = seen_surface(make_renderer(field, cores()), field.metadata)
    mesh = surface_mesh(views, region_of(field.metadata.space), resolution, LEAST_SHARE, cores())
    return mesh.points.astype(np.float64), mesh.triangles


def level_set(field: Field, resolution: int, at: float) -> Mesh:
    """The surface of a bounded field where a step of rendering has the opacity `at`, without any view."""
    space, step = field.metadata.space, field.metadata.space.step
    grid = grid_over(region_of(space).box, resolution)
    workers = Workers(field.metadata.config, cores(), 1, 256, backward=False)
    offsets = np.stack(np.meshgrid(*3 * [np.arange(BLOCK + 1)], indexing="ij")[::-1], axis=-1)
    pieces: list[Piece] = []
    for block in np.ndindex(*grid.blocks):
        start = np.array([block]) * BLOCK
        u = (normalised_points(space, grid.low + grid.cell * (start + offsets)) + 1) / 2
        wanted = _occupied(field, u)
        opacity = np.zeros((1, *wanted.shape), np.float32)
        opacity[0, wanted] = 1 - np.exp(-step * _densities(field, workers, u[wanted].astype(np.float32)))
        pieces.append(isosurface(at - opacity, np.ones_like(opacity, bool), start, grid.nodes))
    workers.close()
    vertices, triangles = joined(pieces)
    return grid.low + grid.cell * vertices, triangles


def _densities(field: Field, workers: Workers, u: np.ndarray) -> np.ndarray:
    out = np.empty(len(u), np.float32)
    workers.each(len(u), 512, lambda s, a, b: densities(field.net, u, a, b, s.samples, out))
    return out


def _occupied(field: Field, u: np.ndarray) -> np.ndarray:
    n = len(field.occupied)
    x, y, z = np.moveaxis(np.clip((u * n).astype(np.int64), 0, n - 1), -1, 0)
    low, high = np.array(field.metadata.space.corners)
    inside = ((low <= 2 * u - 1) & (2 * u - 1 <= high)).all(axis=-1)
    occupied: np.ndarray = field.occupied[z, y, x] & inside
    return occupied


def true_surface(dataset: Dataset) -> Truth:
    """What the views of a dataset with depth show."""
    points, normals = [], []
    for i, record in enumerate(dataset.images):
        camera, pose, depth = record.camera.undistorted(), record.cam_from_object, dataset.load_depth(i)
        normal = normals_of(camera, depth).reshape(-1, 3)
        known = (depth.ravel() > 0) & (np.abs(normal).max(axis=1) > 0)
        points.append(points_at_depth(camera, pose, camera.grid()[known], depth.ravel()[known]))
        normals.append(normal[known] @ pose[:3, :3])
    together = np.concatenate(points)
    return Truth(together, np.concatenate(normals), dataset, cKDTree(together))


def nearness(mesh: Mesh, truth: Truth, near: float, box: np.ndarray | None) -> dict[str, float]:
    """How far points of a mesh are from the true surface (median, p90), and the share of that which has it `near`.

    box (2, 3): only within. Of the mesh counts what the test views would see, be it before the true surface; near that,
    distances are across it.
    """
    rng = np.random.default_rng(0)
    errors = distances(_visible(_sampled(mesh, _SAMPLES, box, rng), truth.dataset, near / 2), truth, near)
    wanted = truth.points[_within(truth.points, box)]
    wanted = wanted[rng.integers(0, len(wanted), _TRUTHS)]
    wide = None if box is None else box + near * np.array([[-3], [3]])
    gaps, _ = cKDTree(_sampled(mesh, _DENSE, wide, rng)).query(wanted)
    median, p90 = np.quantile(errors, (0.5, 0.9))
    return {"median": float(median), "p90": float(p90), "complete": float(np.mean(gaps < near)), "near": near}


def distances(points: np.ndarray, truth: Truth, near: float) -> np.ndarray:
    """Of points (n, 3) to the true surface, (n,): where it is near, to its tangent plane."""
    far, at = truth.tree.query(points)
    across = np.abs(np.einsum("ij,ij->i", points - truth.points[at], truth.normals[at]))
    return np.where(far < near, across, far)


def _sampled(mesh: Mesh, count: int, box: np.ndarray | None, rng: np.random.Generator) -> np.ndarray:
    """Points (count, 3) spread evenly over the triangles whose middle is in the box."""
    points, triangles = mesh
    triangles = triangles[_within(points[triangles].mean(axis=1), box)]
    area = areas(points, triangles)
    a, b, c = points[triangles[rng.choice(len(triangles), count, p=area / area.sum())]].transpose(1, 0, 2)
    s, t = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    sampled: np.ndarray = a * (1 - s) + b * s * (1 - t) + c * s * t
    return sampled


def _within(points: np.ndarray, box: np.ndarray | None) -> np.ndarray:
    return np.ones(len(points), bool) if box is None else ((points > box[0]) & (points < box[1])).all(axis=1)


def _visible(points: np.ndarray, dataset: Dataset, behind: float) -> np.ndarray:
    """Those that are before what a view shows, or no more than so far behind it."""
    seen = np.zeros(len(points), bool)
    for i, record in enumerate(dataset.images):
        in_cam = points @ record.cam_from_object[:3, :3].T + record.cam_from_object[:3, 3]
        pixel = np.nan_to_num(np.rint(record.camera.project(in_cam)), nan=-1).astype(np.int64)
        inside = ((pixel >= 0) & (pixel < (record.camera.width, record.camera.height))).all(axis=1)
        column, row = pixel[inside].T
        seen[inside] |= in_cam[inside, 2] < dataset.load_depth(i)[row, column] + behind
    return points[seen]
