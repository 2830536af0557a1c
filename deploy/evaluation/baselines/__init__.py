"""Published ways to find a pose, on the same field and renderer, to compare with: iNeRF, pi-NeRF, epipolar geometry."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from fieldpose.deploy.evaluation.baselines.essential import Essential, EssentialFound
from fieldpose.deploy.evaluation.baselines.inerf import Inerf, InerfConfig
from fieldpose.deploy.evaluation.baselines.pinerf import PiNerf, PiNerfConfig

__all__ = ["BASELINES", "Essential", "EssentialFound", "Inerf", "InerfConfig", "PiNerf", "PiNerfConfig"]

BASELINES: dict[str, Callable[..., Any]] = {
    "inerf": lambda renderer, settings, **config: Inerf(renderer, InerfConfig(**config)),
    "pi-nerf": lambda renderer, settings, **config: PiNerf(renderer, PiNerfConfig(**config)),
    "essential": lambda renderer, settings: Essential(renderer, settings),
}
"""Name -> what makes it of a renderer, the stages' settings and its own config's values.

Each has find(image, camera, guess) and says by `scale_known` whether its translation means anything.
"""
