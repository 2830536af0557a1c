"""How certain a believed pose is, by what the field has shown on its own training images.

PnP and refinement state covariances by what a single image shows. What an image cannot show, they take to be as on most
scenes: that the field, and the poses that it was learnt from, are off in the same way for all of it. A field that has
been tried on its training images tells how large that is.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fieldpose.bus.messages import CameraOrigin, Reason, TrackingState
from fieldpose.stages.geometry import Limit
from fieldpose.stages.tracking.policy import Belief, FrameInfo

_ELSEWHERE_DEG, _ELSEWHERE = 10.0, 0.2
"""So far from where its view was, in degrees or x scale, a pose errs as on any scene."""


_UNCALIBRATED = {CameraOrigin.EXIF: (0.03, 0.01), CameraOrigin.ASSUMED: (0.25, 0.1)}
"""Standard deviations that the camera adds, in shares of the distance and in radians: cameras state their focal length
in whole millimetres, phones' fields of view lie between 50 and 80 degrees, and photos are cropped."""
_MOST_SCORE = 0.3
_FIELD_FOCAL, _SHAPE_FOCAL, _KEPT = 0.01, 2.0, 0.95
"""How far off the focal length seems with the right camera, since the field's shape is: by a share, and by so many of
the standard deviations of single frames, which grow alike where what is seen is small or flat. On the demo scene and a
hand-held video with two fields, one of them poor, frames are off by up to 0.012 (deviations 0.0003 to 0.001), on a can
cut out of its scene by up to 0.074 (0.016); with a camera that is 0.05 off the scenes say 0.038 to 0.049."""
_DIFFERS, _RIGHT = 2.5, 1.25
"""So many times that, and it differs; then it does so until it seems off by less: it is the same camera."""


def with_camera(belief: Belief, frame: FrameInfo) -> Belief:
    """A belief that is no surer than the frame's camera; from an assumed camera it is LIMITED at best."""
    added, pose = _UNCALIBRATED.get(frame.camera_origin), belief.cam_from_object
    if added is None or pose is None:
        return belief
    distance = float(np.linalg.norm(pose[:3, 3]))
    extra = np.diag([(added[0] * distance) ** 2 / 3] * 3 + [added[1] ** 2 / 3] * 3)
    covariance = None if belief.covariance is None else belief.covariance + extra
    if frame.camera_origin is CameraOrigin.EXIF:
        return replace(belief, covariance=covariance)
    state = TrackingState.LIMITED if belief.state is TrackingState.TRACKING else belief.state
    return replace(belief, covariance=covariance, state=state, score=min(belief.score, _MOST_SCORE))


class FocalCheck:
    """What frames say of the focal length, the newer the more; a camera that is not as said makes no pose certain."""

    def __init__(self) -> None:
        self._sum = self._weight = self._squares = 0.0
        self._differs = False

    @property
    def error(self) -> float:
        """How much longer the focal length seems than said, as a share; 0 while nothing is known."""
        return self._sum / self._weight if self._weight > 0 else 0.0

    def note(self, error: float, sigma: float) -> None:
        """Take in what one frame says."""
        weight = 1 / (sigma**2 + _FIELD_FOCAL**2)
        square = weight * sigma**2 if np.isfinite(sigma) else 0.0
        self._sum, self._weight = _KEPT * self._sum + weight * error, _KEPT * self._weight + weight
        self._squares = _KEPT * self._squares + square

    @property
    def _usual(self) -> float:
        """How far off it may seem, with the right camera."""
        mean = self._squares / self._weight if self._weight > 0 else 0.0
        return float(np.sqrt(_FIELD_FOCAL**2 + _SHAPE_FOCAL**2 * mean))

    def applied(self, belief: Belief) -> Belief:
        """The belief, LIMITED and no surer than that where the focal length differs."""
        pose, off = belief.cam_from_object, abs(self.error)
        self._differs = off >= (_RIGHT if self._differs else _DIFFERS) * self._usual
        if not self._differs or pose is None:
            return belief
        state = TrackingState.LIMITED if belief.state is TrackingState.TRACKING else belief.state
        covariance = belief.covariance
        if covariance is not None:
            along = (off * float(np.linalg.norm(pose[:3, 3]))) ** 2
            covariance = covariance + np.diag([along] * 3 + [off**2 / 3] * 3)
        reason = belief.reason or Reason.CAMERA_DIFFERS
        return replace(belief, state=state, score=min(belief.score, _MOST_SCORE), covariance=covariance, reason=reason)


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
