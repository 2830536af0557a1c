"""A split of a dataset; every frame's true pose is known."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import cast, get_args

from fieldpose.errors import SourceError
from fieldpose.stages.camera.calibration import Calibrator
from fieldpose.stages.camera.config import CameraConfig
from fieldpose.stages.camera.core import CapturedFrame, Source, TruePose
from fieldpose.stages.nerf.datasets import load_dataset
from fieldpose.stages.nerf.datasets.assemble import Split


def open_dataset(rest: str, config: CameraConfig, calibrator: Calibrator) -> Source:
    """dataset:DIR:SPLIT, which knows its cameras. Raises SourceError for an unknown split, and DatasetError."""
    root, split = _parse(rest)
    dataset = load_dataset(root, split, config.size, holdout=config.holdout)

    def frames(first: int) -> Iterator[CapturedFrame]:
        for i, record in enumerate(dataset.images[first:], first):
            truth = TruePose(record.cam_from_object)
            yield CapturedFrame(i, dataset.load_rgb(i), "rgb8", record.camera, record.name, truth=truth)

    return Source(f"{len(dataset)} {split} images of {root}", "none", frames, len(dataset))


def _parse(rest: str) -> tuple[str, Split]:
    root, colon, split = rest.rpartition(":")
    if not colon or Path(rest).is_dir():
        return rest, "test"
    if split not in get_args(Split):
        raise SourceError(f"dataset:{rest}: {split!r} is no split; expected {', '.join(get_args(Split))}")
    return root, cast(Split, split)
