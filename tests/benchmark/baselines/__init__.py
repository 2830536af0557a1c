"""Published ways to find a pose, on the same field and renderer, to compare with: iNeRF, pi-NeRF, epipolar geometry."""

from tests.benchmark.baselines.essential import Essential, EssentialFound
from tests.benchmark.baselines.inerf import Inerf, InerfConfig
from tests.benchmark.baselines.pinerf import PiNerf, PiNerfConfig

__all__ = [
    "BASELINES",
    "SCALE_UNKNOWN",
    "Essential",
    "EssentialFound",
    "Inerf",
    "InerfConfig",
    "PiNerf",
    "PiNerfConfig",
]

BASELINES = {"inerf": Inerf, "pi-nerf": PiNerf, "essential": Essential}
"""Name -> class; each has find(image, camera, guess) and says by `scale_known` whether its translation means anything.

Inerf and PiNerf are made of (renderer, config, seed), Essential of (renderer, settings).
"""
SCALE_UNKNOWN = frozenset(name for name, kind in BASELINES.items() if not kind.scale_known)
"""The ones whose translation is to be left out of a comparison."""
