"""Settings of the camera stage."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from fieldpose.errors import ConfigError

Pace = Literal["auto", "live", "lockstep", "fast"]


@dataclass(frozen=True)
class CameraConfig:
    """A source, its calibration, and the pace at which its frames are sent."""

    source: str
    """folder:DIR, dataset:DIR:test, video:FILE, camera:0, mcap:FILE, bag:FILE (of ROS; bag:FILE#TOPIC where it has
    several), or bus for frames that other programs send."""
    size: int | None = None
    """Shrink images whose longer side has more pixels than this."""
    holdout: Literal["auto", "odd", "every8"] = "auto"
    """Which images of a dataset without splits of its own are the test images."""
    camera_file: Path | None = None
    """The camera of a folder's, video's or device's images: JSON with width, height, fx, fy, cx, cy and distortion (k1
    k2 p1 p2 k3), or a calibration of ROS, OpenCV, Kalibr or COLMAP (cameras.txt); without it the focal length is taken
    from the image's EXIF, or from fov_deg."""
    fov_deg: float = 60.0
    """Field of view along the longer side, where nothing better is known."""
    pace: Pace = "auto"
    """live: by the source's own times; lockstep: a frame when the one before has been answered; fast: at once;
    auto: live for what has times of its own, lockstep for photos."""
    rate_hz: float | None = None
    """Frames a second instead of the source's own times."""
    speed: float = 1.0
    """live: so many times as fast as the source's own times say."""
    every: int = 1
    """Send only every so many-th frame, at its own time."""
    first: int = 0
    """Leave out so many frames at the beginning."""
    frames: int | None = None
    """Stop after so many."""
    objects: tuple[str, ...] = ()
    """All objects that are looked for in its frames, where they are several: a frame is answered once each of them has
    answered."""
    truth_of: str | None = None
    """Of several objects that whose poses the source knows, where it knows true poses (default: the first)."""
    recorded: str | None = None
    """OBJECT/CAMERA: which of a recording's frames to send, where it holds several."""
    answer_timeout_s: float = 15.0
    """Without a sign of life of a frame for so long, lockstep goes on and the end of the source is the end."""
    progress_file: Path | None = None
    """Notes which frame comes next, so that a camera that is started again goes on there."""

    def __post_init__(self) -> None:
        for name in ("size", "rate_hz", "speed", "every", "frames", "answer_timeout_s"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ConfigError(f"camera: {name} is {value}, but must be more than 0")
        if self.first < 0:
            raise ConfigError(f"camera: first is {self.first}, but must not be less than 0")
        if not 1.0 <= self.fov_deg <= 170.0:
            raise ConfigError(f"camera: fov_deg is {self.fov_deg}, but must lie between 1 and 170 degrees")
