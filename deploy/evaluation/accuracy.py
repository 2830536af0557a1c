"""How well a field's own training images are found in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from fieldpose.deploy.local import photo_finder
from fieldpose.deploy.settings import Settings
from fieldpose.stages.geometry import (
    Camera,
    Limit,
    mahalanobis_squared,
    pairwise,
    rotation_error_deg,
    translation_error,
)
from fieldpose.stages.nerf.metadata import PoseAccuracy
from fieldpose.stages.nerf.rendering_api import RayRenderer
from fieldpose.stages.nerf.training_views import TrainingViews
from fieldpose.stages.tracking.config import COVER

_IMAGES = 32
_ENOUGH = 8
_LIKELY = 0.75
"""As many errors are within the ellipsoid of this probability. Half would say little of large errors, and nine in ten
depend on three images."""
_UNLEARNT = 1.2
"""Errors on images that the field was not learnt from are larger: 1.0 to 1.5 times on lego, the lamp and fern."""
_SCALES = 0.25, 4.0
_MOST, _LARGE = 0.8, 2.0


@dataclass(frozen=True)
class TooFew:
    """So many of the images that were looked for were found, which is too few to tell how exactly."""

    images: int
    found: int


def pose_accuracy(
    renderer: RayRenderer,
    views: TrainingViews,
    images: Sequence[np.ndarray],
    cameras: Sequence[Camera],
    settings: Settings,
) -> PoseAccuracy | TooFew:
    """Find some of the training images (h, w, 3) uint8, of these cameras, from the views next to them, unrefined.

    Raises ConfigError and WeightsError.
    """
    if len(views.names) < 2:
        return TooFew(len(views.names), 0)
    settings = replace(
        settings,
        refinement=replace(settings.refinement, when="never"),
        tracking=replace(settings.tracking, searches=0),
    )
    # What is believed of a pose is to be found out here, not taken from what was found out before.
    finder = photo_finder(settings, replace(views, error_scale=1.0), renderer)
    neighbours = _neighbours(views, COVER.scaled(views.scale))
    chosen = np.unique(np.linspace(0, len(images) - 1, _IMAGES).astype(int))
    turns, shifts, distances = [], [], []
    for i in chosen:
        truth = views.cam_from_object[i]
        found = finder.find(images[i], cameras[i], views.cam_from_object[neighbours[i]])
        if found.cam_from_object is None or found.covariance is None:
            continue
        turns.append(rotation_error_deg(found.cam_from_object, truth))
        shifts.append(translation_error(found.cam_from_object, truth))
        distances.append(mahalanobis_squared(found.cam_from_object, found.covariance, truth))
    if len(turns) < _ENOUGH:
        return TooFew(len(chosen), len(turns))
    scale = _UNLEARNT * np.sqrt(np.quantile(distances, _LIKELY) / chi2.ppf(_LIKELY, 6))
    return PoseAccuracy(
        len(chosen), len(turns), float(np.median(turns)), float(np.median(shifts)), float(np.clip(scale, *_SCALES))
    )


def in_words(accuracy: PoseAccuracy | TooFew) -> str:
    """What it says of the field, and where it gives reason to doubt the dataset's poses, that too."""
    if isinstance(accuracy, TooFew):
        told = f"{accuracy.found} of {accuracy.images} training images are found"
        if accuracy.found > _MOST * accuracy.images:
            return f"{told}: all, or nearly, but too few to tell how exactly poses are found"
        return f"{told}: are the dataset's poses, their axes and its camera right?"
    told = (
        f"the pose of a training image is found to {accuracy.rotation_deg:.2g} degrees and"
        f" {accuracy.translation:.2g} units in the median, {accuracy.found} of {accuracy.images}"
    )
    doubtful = accuracy.found < _MOST * accuracy.images or accuracy.error_scale > _LARGE
    return f"{told}; few or inexact: are the dataset's poses and its camera right?" if doubtful else told


def _neighbours(views: TrainingViews, limit: Limit) -> np.ndarray:
    """The training view (n,) next to each."""
    apart = pairwise(views.cam_from_object, views.cam_from_object, limit)
    np.fill_diagonal(apart, np.inf)
    nearest: np.ndarray = apart.argmin(axis=1)
    return nearest
