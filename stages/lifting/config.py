"""Settings of the lifting stage."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from fieldpose.stages.checks import refuse_below


@dataclass(frozen=True)
class LiftingConfig:
    """How lifted points are tested for consistency (the paper's section III-B)."""

    views: int = 6
    """nearby views from which each point is seen again; 0 turns the test off"""
    angle_deg: float = 3.0
    """how far around the point a nearby view is"""
    statistic: Literal["median", "mean"] = "median"
    """mean is the paper's; the median does not blame a thin part, or a point beside an edge, for the few views from
    which something else is seen in its place"""
    gamma: float = 1.0
    """points with a larger displacement, the root of that statistic of its square, are discarded if `enough` remain;
    in gamma_unit"""
    enough: int = 150
    """where fewer points are so consistent, the most consistent ones are kept up to this number"""
    gamma_most: float = 8.0
    """but none whose displacement exceeds this multiple of gamma"""
    gamma_unit: Literal["pixel", "field"] = "pixel"
    """pixel: what one pixel of the view covers at the point's depth; field: the field's own length unit"""
    min_kept: int = 6
    """fewer consistent points than this are reported as a failure"""

    def __post_init__(self) -> None:
        refuse_below(
            "lifting", self, {"views": 0, "angle_deg": 0, "gamma": 0, "enough": 0, "gamma_most": 0, "min_kept": 0}
        )


MIN_OPACITY = 0.5
"""A pixel that is more transparent shows no surface."""
MAX_DEPTH_STEP = 0.03
"""Depths of neighbouring pixels that differ by a larger share belong to two surfaces and are not mixed."""
