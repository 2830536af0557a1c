"""Relative pose from matched pixels alone: the essential matrix between the view at the guess and the image.

Sources: Nistér, An efficient solution to the five-point relative pose problem (2004); Barath et al., MAGSAC++ (2020),
both as OpenCV has them. How far the camera moved cannot be told from directions; its rotation can.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import cv2
import numpy as np

from fieldpose.bus.messages import Reason
from fieldpose.deploy.settings import Settings
from fieldpose.stages.geometry import Camera, camera_centre
from fieldpose.stages.geometry.rigid import from_rotation
from fieldpose.stages.matching.core import MatchedPixels, PairMatcher, build_matcher
from fieldpose.stages.nerf.rendering_api import RayRenderer
from fieldpose.stages.rendering.core import ViewSource

_THRESHOLD_PX, _CONFIDENCE = 0.5, 0.9999
_LEAST = 5


@dataclass(frozen=True)
class EssentialFound:
    """cam_from_object (4, 4) turned rightly, its centre left at the guess's: how far it moved is unknown.

    direction: (3,) of length 1, in object coordinates, from the guess's centre towards the camera's.
    """

    cam_from_object: np.ndarray
    direction: np.ndarray
    inliers: int
    scale_known: bool = False


class Essential:
    """Finds a rotation by matching one view with the image; uses the rendering and matching stages' settings."""

    scale_known: ClassVar[bool] = False

    def __init__(self, renderer: RayRenderer, settings: Settings | None = None) -> None:
        settings = settings or Settings()
        # A view from near the guess would do for the rotation, but not for the direction from the guess.
        self._views = ViewSource(renderer, replace(settings.rendering, reuse_angle_deg=0.0))
        self._matcher = PairMatcher(build_matcher(settings.matching), settings.matching)

    def find(self, image: np.ndarray, camera: Camera, guess: np.ndarray) -> np.ndarray | None:
        """cam_from_object (4, 4) of an image (h, w, 3) uint8 whose rotation alone counts; None if there is none."""
        found = self.relative(image, camera, guess)
        return None if found is None else found.cam_from_object

    def relative(self, image: np.ndarray, camera: Camera, guess: np.ndarray) -> EssentialFound | None:
        """What find() tells, and in which direction the camera moved."""
        sourced = self._views.view(camera, guess)
        if isinstance(sourced, Reason):
            return None
        view = sourced.view
        matched = self._matcher.match(view.rgb, view.opacity, image)
        if isinstance(matched, Reason) or len(matched.confidence) < _LEAST:
            return None
        moved = _frame_from_view(matched, view.camera, camera)
        if moved is None:
            return None
        turn, shift, inliers = moved
        rotation = turn @ view.cam_from_object[:3, :3]
        centre = camera_centre(guess)
        return EssentialFound(from_rotation(rotation, -rotation @ centre), -rotation.T @ shift, inliers)


def _frame_from_view(matched: MatchedPixels, view: Camera, frame: Camera) -> tuple[np.ndarray, np.ndarray, int] | None:
    """Rotation (3, 3), unit translation (3,) and the count of matches that fit; None if too few fit any."""
    in_view = view.directions(matched.pixels_a)[:, :2].astype(np.float64)
    in_frame = frame.directions(matched.pixels_b)[:, :2].astype(np.float64)
    identity, threshold = np.eye(3), _THRESHOLD_PX / view.fx
    matrix, mask = cv2.findEssentialMat(in_view, in_frame, identity, cv2.USAC_MAGSAC, _CONFIDENCE, threshold)
    if matrix is None or matrix.shape != (3, 3) or int(mask.sum()) < _LEAST:
        return None
    count, turn, shift, _ = cv2.recoverPose(matrix, in_view, in_frame, identity, mask=mask)
    return (turn, shift[:, 0], count) if count >= _LEAST else None
