"""Settings of following."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from fieldpose.stages.checks import refuse_below
from fieldpose.stages.geometry import Limit


@dataclass(frozen=True)
class FollowingConfig:
    """How every frame of a video is given its pose at once, while solving goes on beside it."""

    when: Literal["auto", "always", "never"] = "auto"
    """auto: in videos whose frames come at their own times; without it a frame has a pose once it has passed all
    stages"""
    landmarks: int = 450
    """points of a view that are kept for it, those with the most texture"""
    views: int = 24
    """views that are remembered"""
    budget: float = 0.6
    """share of the time between frames that following one may take; beyond it fewer points are looked for"""
    solve_ms: float = 1000.0
    """a frame is solved at least this often, whatever is followed; and at once where little is found or no view has
    seen what the camera will see soon"""
    fresh_deg: float = 3.5
    """how differently from the nearest view the camera may see things before another view is asked for"""
    ahead: float = 1.0
    """for how much of the time that a view takes it is asked for ahead of the motion"""
    same: Limit = Limit(2.0, 0.02)
    """a solve's pose further than this from what was followed speaks against that; x scale"""
    found_again: float = 0.6
    """what a pose must score to be believed where the motion does not lead there, as once tracking was lost"""
    lost_after: int = 15
    """frames in a row that could not be followed until tracking is lost"""
    weak_after: int = 90
    """frames in a row that were followed badly until it is"""

    def __post_init__(self) -> None:
        refuse_below(
            "following",
            self,
            {
                "landmarks": 8,
                "views": 1,
                "budget": 0,
                "ahead": 0,
                "solve_ms": 0,
                "fresh_deg": 0,
                "lost_after": 1,
                "weak_after": 1,
            },
        )


LEVELS = 3
"""Of the images, each half as large as the one before."""
TOGETHER = 3
"""Points of so many views at once."""
COARSE_POINTS = 80
"""Looked for at the coarsest level; half as many again at each finer one but the last."""
KEYFRAMES = 8
"""Views that are kept because that was asked for; beyond them the oldest goes."""
LEAST_FOUND = 8
"""Fewer points are no pose."""
POINTS_BY_LEVEL = (400, 280, 190, 120, 70)
"""How many points are looked for in a frame, from the level at which time is plenty to that where it is shortest."""
