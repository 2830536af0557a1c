"""What `--guess` may say, read in one place: train:NAME, perturb:10-40deg,0.2 or a JSON file."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fieldpose.stages.errors import ConfigError
from fieldpose.stages.geometry import is_rigid, nearest_rigid
from fieldpose.stages.tracking.config import TrackingConfig
from fieldpose.stages.tracking.frame_policies import Disturbance, EachFramePolicy, PerturbedTruthPolicy
from fieldpose.stages.tracking.policy import Policy
from fieldpose.stages.tracking.retrieved import RetrievedPoses
from fieldpose.stages.tracking.track_policy import TrackPolicy
from fieldpose.stages.tracking.views import TrainingViews

_PERTURB = re.compile(r"(\d+(?:\.\d+)?)-(\d+(?:\.\d+)?)deg,(\d+(?:\.\d+)?)")
_RIGID_TOLERANCE = 1e-3


@dataclass(frozen=True)
class GuessFile:
    """The poses of a file: one to start from, or one for each frame by its frame_id."""

    start: np.ndarray | None = None
    frames: dict[int, np.ndarray] = field(default_factory=dict)


def make_policy(config: TrackingConfig, views: TrainingViews, retrieved: RetrievedPoses | None = None) -> Policy:
    """The policy that `config.guess` asks for; it looks into `retrieved`. Raises ConfigError."""
    spec, retrieved = config.guess, retrieved or RetrievedPoses()
    if spec is not None and spec.startswith("perturb:"):
        return PerturbedTruthPolicy(config, views, disturbance(spec), retrieved.of)
    if spec is None or spec.startswith("train:"):
        return TrackPolicy(config, views, None if spec is None else start_pose(spec, views), retrieved)
    content = read_guess_file(Path(spec))
    if content.frames:
        return EachFramePolicy(config, views, content.frames, retrieved.of)
    return TrackPolicy(config, views, content.start, retrieved)


def needs_truth(spec: str | None) -> bool:
    """Whether guesses of this kind are made from the true poses."""
    return spec is not None and spec.startswith("perturb:")


def start_pose(spec: str, views: TrainingViews) -> np.ndarray:
    """cam_from_object (4, 4) of train:NAME, or of a file that holds one pose. Raises ConfigError."""
    if spec.startswith("train:"):
        return views.pose_of(spec.removeprefix("train:"))
    start = read_guess_file(Path(spec)).start
    if start is None:
        raise ConfigError(f'{spec}: holds a guess for each frame, but one pose is needed: {{"cam_from_object": ...}}')
    return start


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
    except (OSError, ValueError) as error:
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
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if not is_rigid(matrix, _RIGID_TOLERANCE):
        raise ConfigError(f"{path}: a guess must be a 4x4 cam_from_object by rows: a rotation, a shift, then 0 0 0 1")
    return nearest_rigid(matrix)
