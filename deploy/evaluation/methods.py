"""The ways to find a pose that are compared: changes of the settings, and published methods on the same field."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from fieldpose.bus.messages import Reason
from fieldpose.deploy.evaluation.baselines import BASELINES
from fieldpose.deploy.local import PoseFinder, PoseFound, photo_finder
from fieldpose.deploy.settings import Settings
from fieldpose.stages.geometry import Camera
from fieldpose.stages.nerf.rendering_api import RayRenderer
from fieldpose.stages.nerf.training_views import TrainingViews


class Finder(Protocol):
    """Finds poses by a method."""

    def find(self, image: np.ndarray, camera: Camera, guess: np.ndarray) -> PoseFound:
        """The pose of an image (h, w, 3) uint8 from a guessed cam_from_object (4, 4)."""
        ...


@dataclass(frozen=True)
class Method:
    """How to make a finder, and what to expect of it.

    slow: takes seconds an image. scale_known: whether its translations mean anything. ablates: the method it is to
    be compared with, where it is that method with a part left out. recalls: needs a field that remembers how its
    training views look.
    """

    make: Callable[[RayRenderer, Settings, TrainingViews], Finder]
    slow: bool = False
    scale_known: bool = True
    ablates: str | None = None
    recalls: bool = False


class _FromLookalike:
    """Our one step from the training view most like the image, whatever the guess is; views are rendered beforehand."""

    def __init__(self, finder: PoseFinder) -> None:
        self._finder = finder
        self._prepared: set[Camera] = set()

    def find(self, image: np.ndarray, camera: Camera, guess: np.ndarray) -> PoseFound:
        if camera not in self._prepared:
            self._finder.prepare(camera)
            self._prepared.add(camera)
        return self._finder.find(image, camera)


class _Baseline:
    """A published method of deploy/evaluation/baselines; it always believes its answer."""

    def __init__(self, method: Any) -> None:
        self._method = method

    def find(self, image: np.ndarray, camera: Camera, guess: np.ndarray) -> PoseFound:
        pose = self._method.find(image, camera, guess)
        return PoseFound(Reason.NO_CONSENSUS) if pose is None else PoseFound(None, pose)


def _ours(change: Callable[[Settings], Settings], ablates: str | None = None) -> Method:
    def make(renderer: RayRenderer, settings: Settings, views: TrainingViews) -> Finder:
        return photo_finder(change(settings), views, renderer)

    return Method(make, ablates=ablates)


def _retrieved(change: Callable[[Settings], Settings]) -> Method:
    def make(renderer: RayRenderer, settings: Settings, views: TrainingViews) -> Finder:
        rendering = replace(settings.rendering, cache_mb=_PREPARED_MB)
        matching = replace(settings.matching, kept_views=len(views.names))
        prepared = replace(settings, rendering=rendering, matching=matching)
        return _FromLookalike(photo_finder(change(prepared), views, renderer))

    return Method(make, recalls=True)


def _published(name: str, *, slow: bool = True, scale_known: bool = True, **config: Any) -> Method:
    def make(renderer: RayRenderer, settings: Settings, views: TrainingViews) -> Finder:
        return _Baseline(BASELINES[name](renderer, settings, **config))

    return Method(make, slow, scale_known)


def _one_step(settings: Settings) -> Settings:
    return _passes(_refined_step(settings))


def _passes(settings: Settings) -> Settings:
    return replace(settings, refinement=replace(settings.refinement, steps=0))


def _unmined(settings: Settings) -> Settings:
    return _one_step(replace(settings, lifting=replace(settings.lifting, views=0)))


def _refined_step(settings: Settings) -> Settings:
    return replace(settings, tracking=replace(settings.tracking, passes=1))


def _anywhere(settings: Settings) -> Settings:
    return _refined_step(replace(settings, refinement=replace(settings.refinement, region="image")))


def _adam(settings: Settings) -> Settings:
    return _refined_step(replace(settings, refinement=replace(settings.refinement, optimiser="adam", steps=40)))


METHODS: dict[str, Method] = {
    "one-step": _ours(_one_step),
    "one-step-unmined": _ours(_unmined, ablates="one-step"),
    "one-step-refined": _ours(_refined_step),
    "one-step-refined-anywhere": _ours(_anywhere, ablates="one-step-refined"),
    "one-step-refined-adam": _ours(_adam, ablates="one-step-refined"),
    "retrieved": _retrieved(_one_step),
    "retrieved-refined": _retrieved(_refined_step),
    "passes": _ours(_passes),
    "full": _ours(lambda settings: settings),
    "essential": _published("essential", slow=False, scale_known=False),
    "inerf": _published("inerf"),
    "inerf-2048": _published("inerf", rays=2048),
    "pi-nerf": _published("pi-nerf"),
    "pi-nerf-camera": _published("pi-nerf", turn_about="camera", loss="mape", angle_deg=15.0, shift=0.3),
}
"""one-step: a single pass; -unmined: without discarding inconsistent points; -refined: and refinement by colours, on
pixels around the keypoints or, -anywhere, of the whole image, -adam, by the paper's 40 steps of Adam; retrieved,
-refined: a single pass, without the guess, from the training view most like the image, all of which are rendered
beforehand; passes: up to tracking.passes of them, from other guesses where the first leads nowhere; full: those and
refinement. essential: rotations from matches alone; inerf, -2048: with so many rays a step; pi-nerf, -camera: turned
about the camera and drawn less widely, closer to its publication; these five are in deploy/evaluation/baselines."""

_PREPARED_MB = 4096.0
DEFAULT = ("one-step", "one-step-unmined", "passes", "full")
