"""Settings of the radiance field and of its training."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from fieldpose.errors import ConfigError

Backend = Literal["auto", "numba", "torch", "cuda"]
"""Compiled kernels on the CPU; torch on the CPU (slow, plain); torch on a CUDA device; auto: on that, if any."""


@dataclass(frozen=True)
class FieldConfig:
    """Shape of the networks; stored with a field, so that any build can render it.

    The density network maps the hash encoding to a density and `features` numbers. The first three features are the
    view-independent colour; all of them, composited along the ray, and the view direction go once per ray through the
    colour network, which adds the view-dependent part (deferred shading as in Hedman et al., "Baking Neural Radiance
    Fields for Real-Time View Synthesis", 2021).
    """

    levels: int = 6
    """Resolutions of the hash grid."""
    level_features: int = 4
    """Features of a table entry."""
    log2_table: int = 18
    """Entries of a level's table, as a power of two; coarse levels that need fewer are stored densely."""
    base_resolution: int = 16
    finest_resolution: int = 1024
    hidden: int = 32
    """Width of the density network's hidden layer."""
    features: int = 15
    """Features composited along a ray; at least 3."""
    colour_hidden: int = 32
    """Width of the colour network's two hidden layers."""
    occupancy_resolution: int = 128
    """Cells of the occupancy grid along an axis; a multiple of 8."""


@dataclass(frozen=True)
class TrainingConfig:
    """How a field is learnt."""

    minutes: float = 5.0
    """Wall-clock time of the training loop."""
    steps: int | None = None
    """Stop after so many steps instead."""
    backend: Backend = "auto"
    """numba: compiled kernels on the CPU; cuda: torch on a CUDA device; auto: cuda where there is one; torch: the same
    on the CPU, for comparison."""
    seed: int = 0
    samples_per_step: int = 1 << 15
    """Rays are added to a step until they carry about so many samples, in the end three times as many."""
    learning_rate: float = 1e-2
    final_learning_rate: float = 5e-4
    distortion: float | None = None
    """Weight of the loss that gathers a ray's weights around one depth (Barron et al., "Mip-NeRF 360", 2022); by
    default 0.01 for what lies in a box, 0.05 for unbounded scenes, whose rays are measured in shorter units."""
    huber_delta: float = 0.1
    threads: int = 0
    """Threads of the kernels; 0 takes all cores."""
    validation_views: int = 4
    """Held-out views that the progress bar's PSNR is measured on."""

    def __post_init__(self) -> None:
        if not self.minutes > 0:
            raise ConfigError(f"training: minutes is {self.minutes:g}, but must be more than 0")
        if self.steps is not None and self.steps < 1:
            raise ConfigError(f"training: steps is {self.steps}, but must be at least 1")
