"""Views and frames of the analytic scene, as following remembers and looks at them."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from support.analytic_scene import AnalyticScene, camera, viewpoint

from fieldpose.stages.alignment.images import FramePyramid
from fieldpose.stages.following.config import LEVELS
from fieldpose.stages.following.core import Follower
from fieldpose.stages.geometry import Camera, rays
from fieldpose.stages.nerf.rendering_api import RenderedView

VIEW = camera(200)
LENS = camera(200, (-0.1, 0.02, 0.001, -0.001, 0.0))
VIEWPOINTS = (viewpoint(20, 35), viewpoint(30, 42), viewpoint(32, 35))


@cache
def the_scene() -> AnalyticScene:
    return AnalyticScene()


def photograph(pose: np.ndarray, lens: Camera = LENS) -> np.ndarray:
    """Grey values (h, w) uint8, read-only, of what a camera sees at that cam_from_object."""
    return _photograph(pose.astype(np.float64).tobytes(), lens)


@cache
def _photograph(pose: bytes, lens: Camera) -> np.ndarray:
    through_pixels = rays(lens, np.frombuffer(pose).reshape(4, 4))
    rgb = the_scene().render_rays(*through_pixels).rgb.reshape(lens.height, lens.width, 3)
    grey = cv2.cvtColor(np.rint(np.clip(rgb, 0, 1) * 255).astype(np.uint8), cv2.COLOR_RGB2GRAY)
    grey.setflags(write=False)
    return grey


def pyramid_of(grey: np.ndarray, lens: Camera = LENS) -> FramePyramid:
    """A frame that is as large as the views."""
    return FramePyramid.of(grey, lens, VIEW.width, LEVELS)


@cache
def _rendered(pose: bytes) -> RenderedView:
    return the_scene().render_view(VIEW, np.frombuffer(pose).reshape(4, 4))


def grey_and_depth(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What a view at that cam_from_object shows, each (h, w)."""
    view = _rendered(pose.astype(np.float64).tobytes())
    return cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY), view.depth


def add_view(follower: Follower, view_id: str, pose: np.ndarray) -> None:
    """Have a view from there remembered."""
    follower.add(view_id, *grey_and_depth(pose), VIEW, pose)
