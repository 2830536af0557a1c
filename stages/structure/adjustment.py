"""Cameras that are a little off, adjusted until what their images share is in one place.

The given cameras are where the adjustment starts, and they decide the frame and the unit: by a similarity, and by where
each was, which counts as much as it turns out to be exact.
"""

from __future__ import annotations

import numpy as np

from fieldpose.stages.geometry import camera_centres
from fieldpose.stages.geometry.arrays import Flags
from fieldpose.stages.structure.colmap import Freedom, PlacePriors, bundle_adjust
from fieldpose.stages.structure.posed import PosedCameras
from fieldpose.stages.structure.similarity import align
from fieldpose.stages.structure.tracks import Tracks
from fieldpose.stages.structure.triangulation import Triangulated, triangulate

FEWEST_SEEN = 30
"""Tracks that an image must show to be adjusted: what COLMAP asks of an image before it is posed."""
LEAST_ANGLE = np.deg2rad(1.5)
"""Between the rays to a point, as COLMAP asks: else nearly nothing is known of its depth."""
_FEWEST_ROUNDS, _MOST_ROUNDS = 3, 10
_SETTLED = 0.01
"""Change of the median error from one round to the next."""
_WRONG = 4.0
"""Times the median error: of errors that are normal along both axes 1 in 65,000 is longer."""
_LEAST_WRONG_PX = 1.0
MEDIAN_LENGTH = float(np.sqrt(2 * np.log(2)))
"""Of normal errors along two axes, in sigmas (Rayleigh's distribution)."""
_MEDIAN_LENGTH_3D = 1.5382
"""The same along three axes (Maxwell's distribution)."""


def supported(tracks: Tracks, images: int) -> Flags:
    """Which of so many images show enough of what others show."""
    return tracks.seen_by(images) >= FEWEST_SEEN


def adjust(given: PosedCameras, tracks: Tracks, freedom: Freedom, start: PosedCameras | None = None) -> PosedCameras:
    """Cameras adjusted to tracks, in the given ones' frame and unit; `start` where other cameras are nearer already.

    Images that show too few tracks keep their poses, and have the camera of those that were taken with it; what
    `freedom` does not name stays as given. What is wrong of the tracks is found as cameras get better: points are
    placed, observations far from them left out, cameras and points adjusted, and so on until nothing changes. The same
    input has the same result. Raises GeometryError where what is found makes no camera.
    """
    images = supported(tracks, len(given))
    inner = tracks.seen_in(images)
    anchors, now = given.chosen(images), (start or given).chosen(images)
    if inner.count == 0:
        return given
    error = np.inf
    for round_ in range(_MOST_ROUNDS):
        found = triangulate(now, inner)
        before, error = error, float(np.median(found.error_px))
        if round_ >= _FEWEST_ROUNDS and abs(before - error) <= _SETTLED * before:
            break
        now = _round(now, anchors, inner, found, freedom, round_ > 0)
    of_given = dict(zip(anchors.cameras, now.cameras, strict=True))
    poses = given.cam_from_object.copy()
    poses[images] = now.cam_from_object
    return PosedCameras(tuple(of_given.get(camera, camera) for camera in given.cameras), poses)


def _round(
    now: PosedCameras, anchors: PosedCameras, tracks: Tracks, found: Triangulated, freedom: Freedom, near: bool
) -> PosedCameras:
    error = float(np.median(found.error_px))
    fitting = tracks.without(found.error_px > max(_WRONG * error, _LEAST_WRONG_PX))
    placed = triangulate(now, fitting)
    behind = np.bincount(fitting.track, ~np.isfinite(placed.error_px), fitting.count) > 0
    good = (placed.angle_rad > LEAST_ANGLE) & ~behind
    noise_px = error / MEDIAN_LENGTH
    priors = _priors(now, anchors) if near and freedom != "focal alone" else None
    adjusted = bundle_adjust(now, placed.points[good], fitting.chosen(good), freedom, noise_px, priors)
    if freedom == "focal alone":
        return adjusted
    similarity = align(adjusted.cam_from_object, anchors.cam_from_object)
    return PosedCameras(adjusted.cameras, similarity.of_poses(adjusted.cam_from_object))


def _priors(now: PosedCameras, anchors: PosedCameras) -> PlacePriors | None:
    """The given places; their sigma is how far they are from where the images have them."""
    centres = camera_centres(anchors.cam_from_object)
    moved = np.linalg.norm(centres - camera_centres(now.cam_from_object), axis=1)
    sigma = float(np.median(moved)) / _MEDIAN_LENGTH_3D
    return PlacePriors(centres, sigma) if sigma > 0 else None
