"""What `--guess` may say, read in one place: train:NAME, perturb:10-40deg,0.2 or a JSON file."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fieldpose.errors import ConfigError
from fieldpose.stages.following.config import FollowingConfig
from fieldpose.stages.geometry import RIGID_TOLERANCE, is_rigid, nearest_rigid
from fieldpose.stages.nerf.training_views import TrainingViews
from fieldpose.stages.tracking.config import TrackingConfig
from fieldpose.stages.tracking.followed import FollowedPolicy
from fieldpose.stages.tracking.photos import PhotoPolicy
from fieldpose.stages.tracking.policy import Policy
from fieldpose.stages.tracking.priors import Priors
from fieldpose.stages.tracking.video import VideoPolicy

_PERTURB = re.compile(r"(\d+(?:\.\d+)?)-(\d+(?:\.\d+)?)deg,(\d+(?:\.\d+)?)")


@dataclass(frozen=True)
class Disturbance:
    """How far a guess is from the truth: angle (least, most) in degrees, largest shift in object units."""

    angle_deg: tuple[float, float] = (10.0, 40.0)
    max_translation: float = 0.2


@dataclass(frozen=True)
class GuessFile:
    """The poses of a file: one to start from, or one for each frame by its frame_id."""

    start: np.ndarray | None = None
    frames: dict[int, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True)
class Beginning:
    """Where tracking begins.

    start: (4, 4) for every photo, or the first frame of a video; frames: (4, 4) by frame_id; disturbance: frames come
    with their true poses, so disturbed, as priors.
    """

    start: np.ndarray | None = None
    frames: dict[int, np.ndarray] = field(default_factory=dict)
    disturbance: Disturbance | None = None

    @property
    def by_frame(self) -> bool:
        """Whether each frame has a guess of its own, so that no frame is to begin without it."""
        return bool(self.frames) or self.disturbance is not None


def beginning(spec: str | None, views: TrainingViews | None) -> Beginning:
    """What `--guess` asks for; of a training view nothing where these are not known. Raises ConfigError."""
    if spec is None:
        return Beginning()
    if spec.startswith("perturb:"):
        return Beginning(disturbance=disturbance(spec))
    if spec.startswith("train:"):
        return Beginning() if views is None else Beginning(start=views.pose_of(spec.removeprefix("train:")))
    content = read_guess_file(Path(spec))
    return Beginning(content.start, content.frames)


def absolute(spec: str | None) -> str | None:
    """The same, with the whole path of a file, so that it is found from other folders too."""
    if spec is None or spec.startswith(("perturb:", "train:")):
        return spec
    return str(Path(spec).resolve())


def make_policy(config: TrackingConfig, views: TrainingViews, looks: bool = False) -> Policy:
    """The policy for the configured sequence and guess; `looks`: whether retrieval can be asked. Raises ConfigError."""
    begins = beginning(config.guess, views)
    policy = PhotoPolicy if config.sequence == "photos" or begins.by_frame else VideoPolicy
    return policy(config, views, Priors(begins.by_frame, begins.frames), begins.start, looks)


def make_followed_policy(
    config: TrackingConfig, following: FollowingConfig, views: TrainingViews, looks: bool = False
) -> FollowedPolicy:
    """The policy for a video whose every frame is followed. Raises ConfigError."""
    begins = beginning(config.guess, views)
    return FollowedPolicy(config, following, views, Priors(), begins.start, looks)


def disturbance(spec: str) -> Disturbance:
    """Read perturb:MIN-MAXdeg,LENGTH. Raises ConfigError."""
    found = _PERTURB.fullmatch(spec.removeprefix("perturb:"))
    if found is None:
        raise ConfigError(f"guess {spec!r}: expected perturb:MIN-MAXdeg,LENGTH as in perturb:10-40deg,0.2")
    least, most, length = (float(number) for number in found.groups())
    if not least <= most <= 180:
        raise ConfigError(f"guess {spec!r}: the angles must rise and be at most 180 degrees")
    return Disturbance((least, most), length)


def read_guess_file(path: Path) -> GuessFile:
    """Read {"cam_from_object": 4x4} or {"frames": {"0": 4x4, ...}}, matrices by rows. Raises ConfigError."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError(f"guess {str(path)!r}: no such file; or write train:NAME or perturb:10-40deg,0.2") from None
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: no readable JSON file of guesses ({error})") from error
    if isinstance(content, dict) and "cam_from_object" in content:
        return GuessFile(start=_pose(path, content["cam_from_object"]))
    if isinstance(content, dict) and isinstance(content.get("frames"), dict) and content["frames"]:
        return GuessFile(frames={_frame_id(path, k): _pose(path, v) for k, v in content["frames"].items()})
    raise ConfigError(f'{path}: expected {{"cam_from_object": 4x4}} or {{"frames": {{"0": 4x4, ...}}}}')


def _frame_id(path: Path, text: str) -> int:
    if not text.isdecimal():
        raise ConfigError(f"{path}: frame {text!r} is not a frame number (0, 1, ...)")
    return int(text)


def _pose(path: Path, rows: Any) -> np.ndarray:
    try:
        matrix = np.array(rows, dtype=np.float64)
    except (TypeError, ValueError, OverflowError, RecursionError):
        matrix = np.zeros(0)
    if not is_rigid(matrix, RIGID_TOLERANCE):
        raise ConfigError(f"{path}: a guess must be a 4x4 cam_from_object by rows: a rotation, a shift, then 0 0 0 1")
    return nearest_rigid(matrix)
