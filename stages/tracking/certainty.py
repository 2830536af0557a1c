"""How certain a believed pose is, by what the field has shown on its own training images.

PnP and refinement state covariances by what a single image shows. What an image cannot show, they take to be as on most
scenes: that the field, and the poses that it was learnt from, are off in the same way for all of it. A field that has
been tried on its training images tells how large that is.
"""

from __future__ import annotations

import numpy as np

from fieldpose.stages.geometry import Limit

_ELSEWHERE_DEG, _ELSEWHERE = 10.0, 0.2
"""So far from where its view was, in degrees or x scale, a pose errs as on any scene."""


class Certainty:
    """Covariances of poses, made true. scale: the spread of the training cameras, in object units."""

    def __init__(self, error_scale: float, scale: float) -> None:
        self._factor = error_scale**2
        self._elsewhere = Limit(_ELSEWHERE_DEG, _ELSEWHERE * scale)

    def of(self, covariance: np.ndarray | None, guess: np.ndarray, pose: np.ndarray) -> np.ndarray | None:
        """The covariance (6, 6) of a pose (4, 4) that was found from a view rendered at `guess`."""
        if covariance is None:
            return None
        apart = min(self._elsewhere.distance_ratio(guess, pose), 1.0)
        scaled: np.ndarray = covariance * (self._factor * (1 - apart) + apart)
        return scaled
