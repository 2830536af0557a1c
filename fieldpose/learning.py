"""Learning a field from posed photographs."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Literal

from fieldpose.deploy.learning import learn_field
from fieldpose.stages.nerf.config import FieldConfig, TrainingConfig
from fieldpose.stages.nerf.field import Field


def train(
    dataset: str | Path, out: str | Path, minutes: float = 5.0, size: int | None = 400,
    report: Callable[[float, float], None] = lambda fraction, psnr_db: None, seed: int = 0,
    cameras: Literal["auto", "given"] = "auto",
) -> Field:  # fmt: skip
    """Learn a field from a folder of posed images, as `fieldpose train` does, and save it at `out` (.safetensors).

    size: the longer side in pixels to which images are shrunk. report: called a few times a second with the share of
    the time that is over and the PSNR (dB) of the last batches. Where the weights of XFeat are installed the field
    knows how its training views look, and how exactly they are found in it (`field.metadata.accuracy`); else a warning
    says so. cameras: "auto" adjusts those that do not fit their images, and `field.metadata.camera_fit` tells how far;
    "given" takes them as they are. Raises FieldposeError for a dataset that cannot be used.
    """
    trained = learn_field(
        Path(dataset), Path(out), size, "auto", TrainingConfig(minutes=minutes, seed=seed), FieldConfig(),
        report=lambda state: report(state.progress.fraction, state.progress.train_psnr_db),
        say=lambda text: warnings.warn(text, stacklevel=4), cameras=cameras,
    )  # fmt: skip
    return trained.field
