"""Which cells of the unit cube hold something: bits for marching, estimates of the density for training."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np

from fieldpose.stages.geometry.cameras import Camera
from fieldpose.stages.nerf.kernels.density import raise_to
from fieldpose.stages.nerf.kernels.types import BLOCK
from fieldpose.stages.nerf.metadata import Space
from fieldpose.stages.nerf.normalise import normalised_points, object_points

LEAST_OPACITY = 0.01


def pack(occupied: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bits (one a cell, x fastest) of an (n, n, n) bool grid [z, y, x], and distances in blocks of 4x4x4 cells.

    A block's distance is the largest difference of an index to that of the nearest occupied block, at most 255.
    """
    # Half a second to import, which no process needs that only reads a field.
    from scipy.ndimage import distance_transform_cdt

    n = occupied.shape[0]
    m = n // BLOCK
    blocks = occupied.reshape(m, BLOCK, m, BLOCK, m, BLOCK).any(axis=(1, 3, 5))
    distance = distance_transform_cdt(~blocks, metric="chessboard") if blocks.any() else np.full(blocks.shape, m)
    return np.packbits(occupied.ravel(), bitorder="little"), np.minimum(distance, 255).ravel().astype(np.uint8)


def cell_positions(cells: np.ndarray, n: int, inside: np.ndarray) -> np.ndarray:
    """Points (k, 3) float32 of the unit cube in flat cells (k,), at `inside` (k, 3) in 0..1 of the cell."""
    index = np.stack([cells % n, cells // n % n, cells // (n * n)], axis=1)
    return ((index + inside) / n).astype(np.float32)


def from_cube(space: Space, u: np.ndarray) -> np.ndarray:
    """Object coordinates (k, 3) of points of the unit cube; NaN outside a contracted space's ball of radius 2."""
    if not space.contracted:
        y = 2 * u.astype(np.float64) - 1
    else:
        z = (u.astype(np.float64) - 0.5) * 4
        norm = np.linalg.norm(z, axis=1, keepdims=True)
        with np.errstate(divide="ignore", invalid="ignore"):
            radius = np.where(norm <= 1, norm, np.where(norm < 2, 1 / (2 - norm), np.nan))
            y = np.where(norm > 0, z * (radius / norm), 0.0)
    return object_points(space, y)


def cell_radii(space: Space, n: int, points: np.ndarray) -> np.ndarray:
    """Of balls around cells with centres (k, 3), in object units: contraction makes far cells larger."""
    half = np.sqrt(3) * space.scale / n
    if not space.contracted:
        return np.full(len(points), half)
    distance = np.linalg.norm(normalised_points(space, points), axis=1)
    return 2 * half * np.maximum(distance, 1) ** 2


def seen_by_cameras(space: Space, n: int, cameras: list[tuple[Camera, np.ndarray]], least: int = 1) -> np.ndarray:
    """(n, n, n) bool: cells that at least `least` (camera, cam_from_object) see, judged by the centre of each 2x2x2."""
    m = n // 2
    points = from_cube(space, cell_positions(np.arange(m**3), m, np.full((1, 3), 0.5)))
    count = np.zeros(m**3, np.int32)
    margin = 1.06
    for camera, cam_from_object in cameras:
        in_cam = points @ cam_from_object[:3, :3].T + cam_from_object[:3, 3]
        with np.errstate(invalid="ignore", divide="ignore"):
            x = np.abs(in_cam[:, 0] / in_cam[:, 2] * camera.fx + camera.cx - (camera.width - 1) / 2)
            y = np.abs(in_cam[:, 1] / in_cam[:, 2] * camera.fy + camera.cy - (camera.height - 1) / 2)
            count += (in_cam[:, 2] > 0) & (x <= margin * camera.width / 2) & (y <= margin * camera.height / 2)
    return (count >= least).reshape(m, m, m).repeat(2, 0).repeat(2, 1).repeat(2, 2)


def near_cameras(space: Space, n: int, cameras: list[tuple[np.ndarray, float]]) -> np.ndarray:
    """(n, n, n) bool: cells whose centre is nearer to one of the camera centres (3,) than its distance."""
    m = n // 2
    points = from_cube(space, cell_positions(np.arange(m**3), m, np.full((1, 3), 0.5)))
    near = np.zeros(m**3, bool)
    for centre, distance in cameras:
        with np.errstate(invalid="ignore"):
            near |= ((points - centre) ** 2).sum(axis=1) < distance**2
    return near.reshape(m, m, m).repeat(2, 0).repeat(2, 1).repeat(2, 2)


def finer(occupied: np.ndarray, densities: Callable[[np.ndarray], np.ndarray], step: float, least: float) -> np.ndarray:
    """(2n, 2n, 2n) bool from (n, n, n): the halves of occupied cells through which a step has an opacity of `least`.

    Judged by the largest of the densities at 3 x 3 x 3 points of the smaller cell; `densities` takes points (k, 3) of
    the unit cube, `step` is that of a ray. Rays that end at a surface then begin nearer to it.
    """
    n = 2 * occupied.shape[0]
    cells = np.flatnonzero(occupied.repeat(2, 0).repeat(2, 1).repeat(2, 2))
    largest = np.zeros(len(cells), np.float32)
    for inside in itertools.product((1 / 6, 1 / 2, 5 / 6), repeat=3):
        np.maximum(largest, densities(cell_positions(cells, n, np.array([inside], np.float32))), out=largest)
    kept = np.zeros(n**3, bool)
    kept[cells[1 - np.exp(-largest * step) >= least]] = True
    return kept.reshape(n, n, n)


class OccupancyEstimate:
    """A running maximum of the density in every cell (Instant-NGP's update), for training.

    allowed, occupied: (n, n, n) bool, the cells that may hold something and those that are marched through.
    """

    def __init__(self, space: Space, n: int, allowed: np.ndarray, rng: np.random.Generator):
        self.space, self.rng, self.allowed = space, rng, allowed
        self._candidates = np.flatnonzero(allowed)
        self._estimate = np.zeros(n**3, np.float32)
        self._held = np.zeros(0, np.int64)
        self.occupied = allowed.copy()

    def hold(self, cells: np.ndarray) -> None:
        """Keep flat cells (k,) occupied, whatever their density, instead of those held until now."""
        self._held = cells
        self._decide()

    @property
    def empty(self) -> np.ndarray:
        """(n, n, n) bool: allowed cells that are marched through only because they are held, or not at all."""
        return self.allowed & ~self._dense().reshape(self.allowed.shape)

    def update(self, densities: Callable[[np.ndarray], np.ndarray], fraction: float, decay: float = 0.95) -> None:
        """Look at a random `fraction` of the cells and at as many of the occupied ones; then decide anew."""
        count = max(1, int(len(self._candidates) * fraction))
        cells = self._candidates
        if fraction < 1:
            occupied = np.flatnonzero(self.occupied)
            among = occupied if len(occupied) else self._candidates
            cells = np.concatenate([self._some(self._candidates, count), self._some(among, min(count, len(among)))])
        n = self.allowed.shape[0]
        u = cell_positions(cells, n, self.rng.random((len(cells), 3), dtype=np.float32))
        self._estimate *= decay
        raise_to(self._estimate, cells, densities(u))
        self._decide()

    def _decide(self) -> None:
        """A cell is occupied where a step through it is opaque enough, or more opaque than the mean is."""
        occupied = self._dense()
        occupied[self._held] = True
        self.occupied = occupied.reshape(self.allowed.shape)

    def _dense(self) -> np.ndarray:
        mean = float(self._estimate.sum(dtype=np.float64)) / max(len(self._candidates), 1)
        return self._estimate > min(LEAST_OPACITY / self.space.step, mean)

    def _some(self, cells: np.ndarray, count: int) -> np.ndarray:
        """Random ones, some of them perhaps twice: drawing without repeats would sort millions of cells."""
        return cells[self.rng.integers(0, len(cells), count)]
