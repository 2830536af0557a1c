"""Cells that marked pixels of views have in common: the visual hull (Laurentini, 1994) of silhouettes or of errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from fieldpose.stages.geometry import camera_centre
from fieldpose.stages.geometry.cameras import Camera
from fieldpose.stages.nerf.metadata import Space
from fieldpose.stages.nerf.occupancy import cell_positions, cell_radii, from_cube

COARSEST = 32
SLACK_PX = 1.0
ROUNDING_PX = 1.5
"""By how much a cell and its half may differ since both are looked up at whole pixels."""
BEHIND = 1.02
"""How many times further away than the depth something counts as hidden."""


@dataclass(frozen=True)
class Marked:
    """A view of which some pixels are marked, (h, w) bool at its camera's size.

    depth: (h, w) distance of the nearest surface from the camera's centre, 0 where there is none; what lies behind
    is not judged by the view.
    """

    pixels: np.ndarray
    camera: Camera
    cam_from_object: np.ndarray
    depth: np.ndarray | None = None


def hull(
    marked: Sequence[Marked], space: Space, among: np.ndarray, contradicted: float, seen_by: int = 1
) -> np.ndarray:
    """(n, n, n) bool: cells of `among` that meet the marked pixels of nearly all views that see them.

    A cell may lie beside what is marked in at most a share `contradicted` of those views, which are to be at least
    `seen_by`. From coarse to fine: halves are looked at of cells alone that may hold something.
    """
    # Takes half a second to import, which no process needs that only reads a field.
    from scipy.ndimage import distance_transform_edt

    away = [
        distance_transform_edt(~m.pixels).astype(np.float32) if m.pixels.any() else np.full(m.pixels.shape, np.inf)
        for m in marked
    ]
    n = m = among.shape[0]
    while m > COARSEST and m % 2 == 0:
        m //= 2
    kept = np.ones((m, m, m), bool)
    while True:
        m = kept.shape[0]
        cells = np.flatnonzero(kept & among.reshape(m, n // m, m, n // m, m, n // m).any(axis=(1, 3, 5)))
        points = from_cube(space, cell_positions(cells, m, np.full((1, 3), 0.5)))
        slack = SLACK_PX + (0 if m == n else ROUNDING_PX)
        against, seeing = _votes(marked, away, points, cell_radii(space, m, points), slack)
        if m < n:  # more views may see a half
            seeing = np.full(len(cells), len(marked))
        kept = np.zeros((m, m, m), bool)
        kept.reshape(-1)[cells[(against <= contradicted * seeing) & (seeing >= seen_by)]] = True
        if m == n:
            return kept
        kept = kept.repeat(2, 0).repeat(2, 1).repeat(2, 2)


def _votes(
    marked: Sequence[Marked], away: Sequence[np.ndarray], points: np.ndarray, radii: np.ndarray, slack: float
) -> tuple[np.ndarray, np.ndarray]:
    """In how many views balls (points (n, 3), radii (n,)) lie beside all that is marked; how many see them."""
    against, seeing = np.zeros(len(points), np.int32), np.zeros(len(points), np.int32)
    for view, distance in zip(marked, away, strict=True):
        camera, pose = view.camera, view.cam_from_object
        pixels = camera.project(points @ pose[:3, :3].T + pose[:3, 3])
        with np.errstate(invalid="ignore"):
            inside = ((pixels >= -0.5) & (pixels < (camera.width - 0.5, camera.height - 0.5))).all(axis=1)
        k = np.flatnonzero(inside)
        x, y = np.rint(pixels[k]).astype(np.int64).T
        far = np.linalg.norm(points[k] - camera_centre(pose), axis=1)
        if view.depth is not None:
            surface = view.depth[y, x]
            open_ = (surface == 0) | (far - radii[k] < BEHIND * surface)
            k, x, y, far = k[open_], x[open_], y[open_], far[open_]
        reach = radii[k] / far * max(camera.fx, camera.fy) + slack
        against[k] += distance[y, x] > reach
        seeing[k] += 1
    return against, seeing


def seen_in(cameras: Sequence[tuple[Camera, np.ndarray]], space: Space, cells: np.ndarray) -> list[np.ndarray]:
    """For each (camera, cam_from_object), (h, w) bool: pixels in which one of the cells, (n, n, n) bool, can be."""
    points = from_cube(space, cell_positions(np.flatnonzero(cells), cells.shape[0], np.full((1, 3), 0.5)))
    radii = cell_radii(space, cells.shape[0], points)
    result = []
    for camera, pose in cameras:
        in_cam = points @ pose[:3, :3].T + pose[:3, 3]
        reach = radii / np.maximum(in_cam[:, 2] - radii, 1e-9) * max(camera.fx, camera.fy)
        pixels = np.zeros((camera.height, camera.width), bool)
        near = ~(in_cam[:, 2] > 2 * radii)
        if near.any() or not len(points):
            result.append(np.full_like(pixels, near.any()))
            continue
        by = int(np.ceil(reach.max() + 0.5))
        x, y = (np.rint(camera.project(in_cam)).astype(np.int64) + by).T
        wide = np.zeros((camera.height + 2 * by, camera.width + 2 * by), np.uint8)
        inside = (x >= 0) & (y >= 0) & (x < wide.shape[1]) & (y < wide.shape[0])
        wide[y[inside], x[inside]] = 1
        grown = cv2.dilate(wide, np.ones((2 * by + 1, 2 * by + 1), np.uint8))
        result.append(grown[by : by + camera.height, by : by + camera.width].astype(bool))
    return result
