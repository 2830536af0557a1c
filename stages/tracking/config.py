"""Settings of tracking. Lengths marked "x scale" are shares of the spread of the training cameras.

The limits were found on lego, fern, fox and the demo sequence, whose cameras turn by up to 110 degrees a second.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Literal

from fieldpose.errors import ConfigError
from fieldpose.stages.geometry import Limit


@dataclass(frozen=True)
class MotionConfig:
    """The constant-velocity model on SE(3)."""

    window_ms: float = 150.0
    """The velocity is taken between the newest pose and the oldest one at most this much older."""
    horizon_ms: float = 1000.0
    """Poses further apart than this say nothing about the velocity, nor does a velocity reach further."""
    damping_ms: float = 200.0
    """The velocity is taken to decay with this time constant; inf keeps it."""
    most: Limit = Limit(20.0, 0.5)
    """Largest turn and shift that are predicted; x scale."""


@dataclass(frozen=True)
class ScoreConfig:
    """A pose scores the weakest of these measures, each 1 at its good value or better."""

    min_inliers: int = 8
    """Fewer score 0."""
    good_inliers: int = 40
    good_inlier_ratio: float = 0.55
    """Of the points that were looked for, matched ones and landmarks, those found where the pose puts them."""
    good_residual_px: float = 2.0
    """Root mean square of the inliers' reprojection errors."""
    good_sigma: Limit = Limit(1.0, 0.02)
    """Standard deviations of rotation and translation, from the covariance of the pose; x scale."""
    usable: float = 0.2
    """A pose that scores less is not used."""
    good: float = 0.4
    """What it takes to trust tracking again after it was limited or lost, and to believe the pose of an image that
    stands by itself where another pass has found it again."""
    sure: float = 0.9
    """What it takes to believe the pose of an image that stands by itself before another pass has found it again."""


@dataclass(frozen=True)
class TrackingConfig:
    """Admission, guesses and trust."""

    guess: str | None = None
    """Where to begin: a JSON file, train:NAME, or perturb:10-40deg,0.2 (each frame's true pose, disturbed); without
    it, training views are tried, those that look like the frame first."""
    sequence: Literal["auto", "video", "photos"] = "auto"
    """Photos stand each by itself, in videos the motion carries on; auto: by the source, and video where another host
    has it."""
    depth: int = 2
    """Frames solved at once; one where every frame is followed."""
    passes: int = 3
    """Most passes from one guess that may be far off: the pose found becomes the next guess."""
    retries: int = 1
    """How many other guesses to try on the same frame of a video when one has led nowhere."""
    searches: int = 40
    """How many training views to try, those that look like it first, then those nearest to the guess, for a photo
    whose pose was not found from its guess; none where there is only one pass. Each costs a pass or more."""
    seed: int = 0
    """Of the disturbed guesses."""
    max_deadline_ms: float = 10_000.0
    """A pass without a result is given up after this time."""
    min_deadline_ms: float = 1500.0
    """It is given up no sooner than this."""
    guess_wait_ms: float = 500.0
    """How long a frame may wait for its own guess (perturb, or a file of guesses by frame)."""
    settled: Limit = Limit(1.0, 0.005)
    """A pose this near its guess needs no further pass; x scale."""
    far: Limit = Limit(20.0, 0.25)
    """A pose this far from its guess is not believed before another pass has found it again; x scale."""
    jump: Limit = Limit(8.0, 0.08)
    """A pose further than this from the motion model's is a jump, and waits for a second frame to confirm it; x
    scale."""
    jump_per_s: Limit = Limit(180.0, 1.0)
    """How the allowance grows with the time since the last pose; x scale."""
    lost_after: int = 3
    """Frames in a row without a usable pose until tracking is lost."""
    weak_after: int = 20
    """Frames in a row with usable but never good poses until it is, once limited."""
    motion: MotionConfig = field(default_factory=MotionConfig)
    score: ScoreConfig = field(default_factory=ScoreConfig)

    def __post_init__(self) -> None:
        least_values = {"depth": 1, "passes": 1, "retries": 0, "searches": 0, "lost_after": 1, "weak_after": 1}
        for name, least in least_values.items():
            if getattr(self, name) < least:
                raise ConfigError(f"tracking: {name} is {getattr(self, name)}, but must be at least {least}")
        for part in (self, self.motion, self.score):
            _refuse_negative(part)


def _refuse_negative(config: object) -> None:
    for item in fields(config):  # type: ignore[arg-type]
        value = getattr(config, item.name)
        if isinstance(value, int | float) and not value >= 0:
            raise ConfigError(f"tracking: {item.name} is {value}, but must not be negative")


COVER = Limit(20.0, 0.3)
"""Searches try training views until each view is this near one of those tried; x scale. From a view within it one step
finds nearly every pose on lego, the lamp and fern."""
KEYFRAME = Limit(10.0, 0.1)
"""A good pose further than this from every keyframe becomes one; x scale."""
KEYFRAMES = 50
"""Good poses that are remembered."""
DEADLINE_FACTOR = 10.0
"""A pass is given up after so many times the usual latency, within the two limits that are set."""
