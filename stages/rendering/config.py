"""Settings of the rendering stage."""

from __future__ import annotations

from dataclasses import dataclass

from fieldpose.stages.checks import refuse_below

_DEFAULT_SIZE = 400


@dataclass(frozen=True)
class RenderingConfig:
    """How large views are, and when an old one is near enough to be used again."""

    size: int = 0
    """longer side of a view in pixels, never more than the frame's; 0: 400, and 256 for videos, where time is short"""
    min_visible: float = 0.002
    """a view whose pixels show the object to a smaller share is reported as a failure"""
    reuse_angle_deg: float | None = None
    """a cached view is used again if surface points are seen from directions that differ by no more; 0: only for the
    very same pose; by default 5 in videos and 0 for photos, so that none depends on another"""
    reuse_shift: float = 0.1
    """and if they are shifted by no more than this share of the image's longer side (root mean square)"""
    next_pass_share: float = 0.2
    """a next pass over the same frame wants a view that is nearer than the last: its share of the two limits"""
    cache_mb: float = 64.0
    """memory for cached views; the longest unused ones are forgotten"""

    def __post_init__(self) -> None:
        refuse_below(
            "rendering", self, {"size": 0, "min_visible": 0, "reuse_shift": 0, "next_pass_share": 0, "cache_mb": 0}
        )

    @property
    def reuse_within_deg(self) -> float:
        """The angle, where it was not left open."""
        return self.reuse_angle_deg or 0.0

    @property
    def longer_side(self) -> int:
        """Of views, where the frame is no smaller."""
        return self.size or _DEFAULT_SIZE
