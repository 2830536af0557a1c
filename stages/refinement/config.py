"""Settings of the refinement stage."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from fieldpose.stages.checks import refuse_below


@dataclass(frozen=True)
class RefinementConfig:
    """How a pose is refined by colours (the paper's section III-C)."""

    when: Literal["auto", "always", "never"] = "auto"
    """auto: not in videos, whose views are so near that the search in the frame leaves it nothing to gain"""
    steps: int = 40
    """at most so many steps; 0 turns refinement off"""
    optimiser: Literal["lm", "adam"] = "lm"
    """lm: Levenberg-Marquardt on one sample of pixels; adam: the paper's, on a new sample in each step"""
    derivative: Literal["image", "field"] = "image"
    """image: by the frame's slopes, carried along by the surface's motion; field: through the field itself"""
    region: Literal["keypoints", "image"] = "keypoints"
    """where pixels are taken from: around the matched keypoints, or anywhere (wrong where something is in front)"""
    dilations: int = 4
    """n: how often the keypoints are dilated by 5 x 5 pixels"""
    samples: int = 768
    """pixels in each step"""
    held_out: int = 512
    """pixels that decide whether the refined pose is the better one; no step sees them"""
    size: int = 400
    """longer side in pixels to which the frame is shrunk"""
    colours: Literal["grey", "rgb"] = "grey"
    """compare grey values or the three channels"""
    background: Literal["ignore", "compare"] = "ignore"
    """ignore: where the field is transparent a pixel counts for nothing; compare: the frame has the field's own"""
    outlier: float = 0.2
    """colour differences (0..1) well beyond it are something else than the object, and hardly pull"""

    seed: int = 0
    """Of the choice of pixels."""

    def __post_init__(self) -> None:
        refuse_below("refinement", self, {"steps": 0, "dilations": 0, "samples": 1, "held_out": 0, "size": 1})

    @property
    def on(self) -> bool:
        """Whether poses are refined at all."""
        return self.when != "never" and self.steps > 0

    @property
    def needs_jacobian(self) -> bool:
        """Whether the field's own derivatives are asked for."""
        return self.on and self.derivative == "field"
