"""Placing points of a view in a frame by comparing the two, once the pose is nearly known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from fieldpose.stages.alignment import constants
from fieldpose.stages.alignment.images import FramePyramid
from fieldpose.stages.alignment.least_squares import intrinsics_of
from fieldpose.stages.alignment.patches import find_patches
from fieldpose.stages.alignment.views import ViewPoints
from fieldpose.stages.alignment.warps import warp_patches
from fieldpose.stages.geometry import inverse, unscale_pixels
from fieldpose.stages.geometry.arrays import Indices, Matrices2, Pixels64, Transform


@dataclass(frozen=True)
class Placed:
    """Points that were found in the frame: which, their pixels, and how exact these are.

    weights: their inverse covariances up to a factor: an edge's patch tells nothing of where it is along it.
    seen: which of all points the pose puts into the frame.
    """

    index: Indices
    pixels: Pixels64
    weights: Matrices2
    seen: Bool[np.ndarray, " points"]


@dataclass(frozen=True)
class Warped:
    """Where a pose puts a view's points in a frame, in pixels of its pyramid's first level, and how patches are warped.

    starts (n, 2) and warps (n, 2, 2) float32 count only where seen (n,) bool.
    """

    starts: np.ndarray
    warps: np.ndarray
    seen: np.ndarray


def warped(view: ViewPoints, frame: FramePyramid, cam_from_object: Transform) -> Warped:
    """The view's points as a frame at that pose shows them."""
    count = len(view.pixels)
    starts, warps, seen = np.empty((count, 2), np.float32), np.empty((count, 2, 2), np.float32), np.empty(count, bool)
    warp_patches(
        view.pixels, view.inverse_depth, view.slopes, intrinsics_of(view.camera),
        cam_from_object @ inverse(view.cam_from_object), intrinsics_of(frame.camera),
        np.array(frame.camera.distortion), (frame.camera.width, frame.camera.height), starts, warps, seen,
    )  # fmt: skip
    return Warped(starts, warps, seen)


def place(view: ViewPoints, frame: FramePyramid, at: Warped, level: int, index: Indices) -> Placed:
    """Look for those points of the view near where they are put; patches are 2^level pixels coarse."""
    smaller = np.float32(0.5**level)
    places, similarity = np.empty((len(index), 2), np.float32), np.empty(len(index), np.float32)
    covariance = np.empty((len(index), 2, 2), np.float32)
    find_patches(
        view.levels[level], frame.levels[level], (view.pixels[index] * smaller).astype(np.float32), at.warps[index],
        at.starts[index] * smaller, constants.HALF, constants.STEPS, places, similarity, covariance,
    )  # fmt: skip
    places /= smaller
    end = (frame.camera.width - 1, frame.camera.height - 1)
    found = ((places >= 0) & (places <= end)).all(axis=1) & (similarity > constants.SIMILARITY)
    pixels = unscale_pixels(places[found].astype(np.float64), frame.scale)
    # In pixels of the view, of which the frame's are all the same multiple.
    covariance = covariance[found].astype(np.float64) * 4**level
    return Placed(index[found], pixels, np.linalg.inv(covariance + constants.FLOOR_PX**2 * np.eye(2)), at.seen)
