"""A field that is learnt, remembers how its training views look, and has been tried on them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from fieldpose.deploy.cameras import Cameras, fit_cameras, in_words, kept_in_words
from fieldpose.deploy.settings import Settings
from fieldpose.errors import WeightsError
from fieldpose.stages.matching.core import MatchingConfig
from fieldpose.stages.nerf.config import FieldConfig, TrainingConfig
from fieldpose.stages.nerf.datasets import Dataset
from fieldpose.stages.nerf.datasets.assemble import Holdout
from fieldpose.stages.nerf.field import Field
from fieldpose.stages.nerf.from_dataset import FittedCameras, Only, TrainedField, TrainingReport, train_field
from fieldpose.stages.nerf.metadata import DESCRIBED_SIZE, PoseAccuracy

Say = Callable[[str], None]


def learn_field(
    dataset: Path,
    out: Path,
    size: int | None,
    holdout: Holdout | None,
    training: TrainingConfig,
    model: FieldConfig,
    matching: MatchingConfig | None = None,
    report: Callable[[TrainingReport], None] = lambda state: None,
    say: Say = lambda text: None,
    cameras: Cameras = "auto",
    note: Say = lambda text: None,
    looked: Callable[[str, float], None] = lambda what, share: None,
    only: Only | None = None,
) -> TrainedField:
    """Learn, save, describe and examine a field; see train_field.

    say: is told in a line where weights are missing, without which the field remembers nothing, or is not examined, and
    what of the dataset a user should know. cameras: whether those that do not fit their images are adjusted. note: is
    told that they fit, or how they were adjusted. looked: is told what is done before the training, and its share.
    only: what of the dataset is learnt, where that is not all.
    Raises DatasetError, ConfigError.
    """
    matching = matching or MatchingConfig()
    return train_field(
        dataset, out, size, holdout, training, model, report,
        lambda images: described(images, matching, say),
        lambda field, images: _examined(field, images, matching, training, say),
        say,
        lambda found: None if cameras == "given" else _fitted(found, holdout, training.threads, say, note, looked),
        only,
    )  # fmt: skip


def _fitted(
    dataset: Dataset, holdout: Holdout | None, threads: int, say: Say, note: Say, looked: Callable[[str, float], None]
) -> FittedCameras:  # fmt: skip
    fitted = fit_cameras(dataset, holdout, threads, looked)
    in_order = fitted.fit.verdict in ("fit", "adjusted")
    (note if in_order else say)(in_words(fitted.fit, dataset.unit))
    kept = kept_in_words(fitted.fit)
    if kept is not None:
        say(kept)
    return fitted


def described(images: Iterable[np.ndarray], matching: MatchingConfig, say: Say) -> np.ndarray | None:
    """What the field remembers of its training views; None where the weights are missing."""
    # Torch takes 300 MB, of which the training has no need.
    from fieldpose.stages.retrieval.core import describer, remembered

    try:
        describe = describer(matching, DESCRIBED_SIZE)
    except WeightsError as error:
        say(f"the field does not remember its training views, for retrieval: {error}")
        return None
    return remembered(describe(image) for image in images)


def _examined(
    field: Field, images: Sequence[np.ndarray], matching: MatchingConfig, training: TrainingConfig, say: Say
) -> PoseAccuracy | None:
    """How well its own training images are found in it; None where the weights are missing."""
    from fieldpose.deploy.evaluation import accuracy
    from fieldpose.stages.nerf.loading import make_renderer
    from fieldpose.stages.nerf.training_views import training_views

    renderer = make_renderer(field, training.threads, training.backend)
    try:
        found = accuracy.pose_accuracy(
            renderer, training_views(field), images, [view.camera for view in field.metadata.cameras],
            replace(Settings(), matching=matching),
        )  # fmt: skip
    except WeightsError as error:
        say(f"the field is not tried on its training images, and its covariances are not scaled: {error}")
        return None
    if isinstance(found, PoseAccuracy):
        return found
    say(f"from the training view next to it, {accuracy.in_words(found)}")
    return None
