"""From posed images on disk to a trained field on disk."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import msgspec
import numpy as np

from fieldpose.errors import ConfigError, DatasetError
from fieldpose.stages.nerf.backend import resolved
from fieldpose.stages.nerf.blocks import View
from fieldpose.stages.nerf.config import FieldConfig, TrainingConfig
from fieldpose.stages.nerf.cropping import box_within, cropped, in_words
from fieldpose.stages.nerf.datasets import Dataset, PosedCamera, load_dataset
from fieldpose.stages.nerf.datasets.images import over_background
from fieldpose.stages.nerf.field import Field
from fieldpose.stages.nerf.metadata import CameraFit, FieldMetadata, PoseAccuracy, Space, TrainingCamera
from fieldpose.stages.nerf.occupancy import finer
from fieldpose.stages.nerf.renderer import NumbaRenderer
from fieldpose.stages.nerf.training import Learner, Progress, Trainer, evaluate

if TYPE_CHECKING:
    from fieldpose.stages.nerf.datasets.assemble import Holdout

Only = Literal["box", "masks"]
GREY = (0.5, 0.5, 0.5)
"""Behind a field of all that the images show, where a ray ends in nothing."""
BOUNDED_STEP, CONTRACTED_STEP = 2 / 384, 1 / 128
CONTRACTED_FAR = 64.0
FEW = 8
"""Training images; with fewer a user is told."""
EDGE = 1 / 16
"""How much a box of all that images show grows on each side, of its largest half: walls and floors often lie on its
faces, and become opaque only over some steps: with 1 % a papered room is not learnt at all, with 3 % slowly."""
REPORT_EVERY_S = 0.25
VALIDATION_STRIDE = 41
PRUNED_BELOW = (0.02, 0.005)
"""Opacity of a step through a cell that is dropped, tried in turn."""
PRUNING_VIEWS, PRUNING_MAY_COST_DB = 16, 0.02


@dataclass(frozen=True)
class TrainingReport:
    """What the progress display shows: see Progress; `validation_psnr_db` is None until it was first measured.

    preview: a held-out image beside what the field shows in its place, (h, 2 w, 3) uint8, where both are new.
    """

    progress: Progress
    validation_psnr_db: float | None
    preview: np.ndarray | None = None


@dataclass(frozen=True)
class FittedCameras:
    """What became of a dataset's cameras; `cameras` of all its images, or None where they stay as given."""

    fit: CameraFit
    cameras: Sequence[PosedCamera] | None


@dataclass(frozen=True)
class TrainedField:
    """The result of a training; `interrupted` where Ctrl-C ended it early."""

    field: Field
    test_psnr_db: list[float]
    interrupted: bool


def space_of(dataset: Dataset) -> Space:
    """The field's space for a dataset: its box where it has one, all space contracted around its ball otherwise."""
    bounds = dataset.bounds
    if dataset.scene == "unbounded":
        near = max(bounds.near / bounds.radius, 0.02)
        centre = tuple(float(v) for v in bounds.centre)
        return Space(True, centre, float(bounds.radius), near=near, far=CONTRACTED_FAR, step=CONTRACTED_STEP)  # type: ignore[arg-type]
    centre = tuple(float(v) for v in bounds.aabb.mean(axis=0))
    half = (bounds.aabb[1] - bounds.aabb[0]) / 2
    if dataset.scene == "bounded":
        half = half + EDGE * half.max()
    scale = float(half.max())
    share = tuple(float(v) for v in half / scale)
    near = max(0.25 * bounds.near / scale, 0.01)
    return Space(False, centre, scale, half=share, near=near, far=64.0, step=BOUNDED_STEP)  # type: ignore[arg-type]


def views_of(dataset: Dataset) -> list[View]:
    """All images of a dataset, loaded."""
    images = dataset.load_images()
    behind = None if dataset.has_alpha else _background(dataset)
    return [
        View(record.name, image, record.camera, record.cam_from_object, behind, dataset.load_learnt(i))
        for i, (record, image) in enumerate(zip(dataset.images, images, strict=True))
    ]


def _background(dataset: Dataset) -> tuple[float, float, float] | None:
    if dataset.background is None:
        return None
    red, green, blue = dataset.background
    return red / 255, green / 255, blue / 255


def _camera_record(view: View) -> TrainingCamera:
    c = view.camera
    numbers = tuple(float(v) for v in view.cam_from_object.ravel())
    return TrainingCamera(view.name, c.width, c.height, c.fx, c.fy, c.cx, c.cy, c.distortion, numbers)


def metadata_of(dataset: Dataset, views: list[View], config: FieldConfig) -> FieldMetadata:
    """What is known of a field before it is trained."""
    try:
        made_by = f"fieldpose {version('fieldpose')}"
    except PackageNotFoundError:
        made_by = "fieldpose"
    return FieldMetadata(
        space=space_of(dataset),
        config=config,
        background=_background(dataset) or GREY,
        cameras=[_camera_record(v) for v in views],
        dataset_kind=dataset.kind,
        dataset_sha256=dataset.content_hash(),
        unit=dataset.unit,
        metres_per_unit=dataset.metres_per_unit,
        has_background=dataset.scene != "object",
        made_by=made_by,
    )


def train_field(
    path: Path,
    out: Path,
    size: int | None = 400,
    holdout: Holdout | None = "auto",
    training: TrainingConfig | None = None,
    config: FieldConfig | None = None,
    report: Callable[[TrainingReport], None] = lambda _: None,
    remember: Callable[[Iterable[np.ndarray]], np.ndarray | None] = lambda images: None,
    examine: Callable[[Field, Sequence[np.ndarray]], PoseAccuracy | None] = lambda field, images: None,
    say: Callable[[str], None] = lambda text: None,
    fit: Callable[[Dataset], FittedCameras | None] = lambda dataset: None,
    only: Only | None = None,
) -> TrainedField:
    """Train on a dataset's training images, measure on its held-out ones, and save; Ctrl-C ends the training early.

    remember: makes the field's descriptors of the training images, (h, w, 3) uint8, or None if that cannot be.
    examine: finds out how well these are found in the field, or None if that cannot be; not where the training was
    ended early.
    say: is told, a line each, what of the dataset a user should know.
    fit: is given the training images, finds out whether the dataset's cameras fit, and cameras of both splits that do
    where they do not.
    only: an object alone, "box": what is in the dataset's object_aabb, of a field of all that the images show; "masks":
    what their masks show, as if the rest were transparent.
    Raises DatasetError; nothing is written before the training is over.
    """
    training, config = training or TrainingConfig(), config or FieldConfig()
    cut_out = only == "masks"
    dataset = load_dataset(path, "train", size, holdout=holdout, cut_out=cut_out)
    box = _box_of(dataset) if only == "box" else None
    say(_what(dataset, box))
    for note in dataset.notes:
        say(note)
    if len(dataset) < FEW:
        say(f"only {len(dataset)} training images: what two of them do not show from different sides is not learnt")
    fitted = fit(dataset)
    cameras = None if fitted is None else fitted.cameras
    if cameras is not None:
        dataset = load_dataset(path, "train", size, holdout=holdout, cameras=cameras, cut_out=cut_out)
    views = views_of(dataset)
    if all(view.learnt is not None and not view.learnt.any() for view in views):
        raise DatasetError(f"{path}: the masks (mask_path) leave nothing to learn from; white is what counts")
    masked = sum(view.learnt is not None for view in views)
    if masked:
        say(f"{masked} of {len(views)} training images have masks: what these leave out is not learnt")
    held_out = held_out_views(path, size, holdout, cameras, cut_out)
    metadata = replace_metadata(metadata_of(dataset, views, config), camera_fit=None if fitted is None else fitted.fit)
    trainer = make_learner(views, metadata.space, config, training)
    monitor = _Monitor(trainer, metadata, held_out[: training.validation_views], report)
    start = time.monotonic()
    interrupted = False
    try:
        trainer.run(monitor)
    except KeyboardInterrupt:
        interrupted = True
    field = finished(
        trainer,
        replace_metadata(metadata, trained_seconds=time.monotonic() - start, trained_steps=trainer.steps),
        views,
    )
    # Saved after each step, since what comes next takes a while and may be ended by Ctrl-C.
    field.save(out)
    images = [over_background(view.image, dataset.background) for view in views]
    scores = evaluate(NumbaRenderer(field, training.threads), held_out) if held_out and not interrupted else []
    if box is not None:
        field = _cut(field, box, out)
    # Of what was learnt alone, images show much else beside it.
    field.descriptors = remember(images if box is None else own_views(field, training.threads))
    field.save(out)
    # Those are of the whole.
    if scores and box is None:
        field.metadata = replace_metadata(field.metadata, psnr_db=float(np.mean(scores)))
    if not interrupted:
        field.metadata = replace_metadata(field.metadata, accuracy=examine(field, images))
    field.save(out)
    return TrainedField(field, scores, interrupted)


def own_views(field: Field, threads: int) -> Iterator[np.ndarray]:
    """What a field shows of itself to its training views, images (h, w, 3) uint8."""
    renderer = NumbaRenderer(field, threads)
    try:
        for view in field.metadata.cameras:
            yield renderer.render_view(view.camera.undistorted(), view.pose).rgb
    finally:
        renderer.close()


def _box_of(dataset: Dataset) -> np.ndarray:
    box = dataset.object_aabb
    if box is None:
        raise DatasetError(
            f"{dataset.root}: names no box to learn alone; write one as object_aabb into transforms.json, [[lowest x,"
            " y, z], [highest x, y, z]], or train without, and then use `fieldpose crop`"
        )
    try:
        box_within(space_of(dataset), box)
    except ConfigError as error:
        raise DatasetError(f"{dataset.root}: {error}") from error
    return box


def _cut(field: Field, box: np.ndarray, out: Path) -> Field:
    try:
        return cropped(field, box)
    except ConfigError as error:
        raise DatasetError(f"{error}; {out} holds the whole scene") from error


def _what(dataset: Dataset, box: np.ndarray | None) -> str:
    if box is not None:
        return f"learning an object alone: what is in the box {in_words(box)}; the rest is learnt first, then left out"
    if dataset.cut_out:
        return "learning an object alone: what the masks show"
    if dataset.scene == "object":
        shown = "what the images do not leave transparent" if dataset.has_alpha else "what is before a plain background"
        return f"learning an object alone: {shown}"
    return "learning the whole scene, in which the object has to stay where it is (--only box learns it alone)"


def finished(learner: Learner, metadata: FieldMetadata, views: Sequence[View]) -> Field:
    """The field as learnt, its occupied cells halved: what is nearly empty is dropped, if no view shows the difference.

    In a field that was learnt for a short time, colours may still be haze, each step through which is nearly nothing.
    """
    field = learner.field(metadata)
    cells, some = field.occupied, views[:: max(1, len(views) // PRUNING_VIEWS)]

    def quality() -> float:
        renderer = NumbaRenderer(field, learner.config.threads)
        score = float(np.mean(evaluate(renderer, list(some), VALIDATION_STRIDE)))
        renderer.close()
        return score

    before = quality()
    for least in PRUNED_BELOW:
        field.occupied = finer(cells, learner.densities, metadata.space.step, least)
        if quality() > before - PRUNING_MAY_COST_DB:
            return field
    field.occupied = cells
    return field


def make_learner(views: list[View], space: Space, config: FieldConfig, training: TrainingConfig) -> Learner:
    """Compiled kernels, or torch on the CPU or on CUDA. Raises ConfigError where there is no CUDA device."""
    backend = resolved(training.backend)
    if backend == "numba":
        return Trainer(views, space, config, training)
    from fieldpose.stages.nerf.torch_renderer import torch_device
    from fieldpose.stages.nerf.torch_training import TorchTrainer

    return TorchTrainer(views, space, config, training, torch_device(backend))


def replace_metadata(metadata: FieldMetadata, **changes: object) -> FieldMetadata:
    """A copy with some entries changed."""
    return msgspec.structs.replace(metadata, **changes)


def held_out_views(
    path: Path, size: int | None, holdout: Holdout | None, cameras: Sequence[PosedCamera] | None = None,
    cut_out: bool = False,
) -> list[View]:  # fmt: skip
    """The held-out images of a dataset, loaded; none where nothing is held out. cameras, cut_out: see load_dataset."""
    if holdout is None:
        return []
    both = load_dataset(path, "all", size, holdout=holdout, cameras=cameras, cut_out=cut_out)
    test = tuple(record for record in both.images if record.split == "test")
    views = views_of(replace(both, images=test)) if test else []
    return [view for view in views if view.learnt is None or view.learnt.any()]


class _Monitor:
    """Passes progress on at most a few times a second, and renders held-out views at each fifth of the training."""

    def __init__(
        self,
        trainer: Learner,
        metadata: FieldMetadata,
        views: list[View],
        report: Callable[[TrainingReport], None],
    ):
        self._trainer, self._metadata, self._views, self._report = trainer, metadata, views, report
        self._psnr: float | None = None
        self._next_time, self._next_fraction = 0.0, 0.2

    def __call__(self, progress: Progress) -> None:
        preview = None
        if self._views and progress.fraction >= self._next_fraction:
            self._next_fraction += 0.2
            renderer = NumbaRenderer(self._trainer.field(self._metadata), self._trainer.config.threads)
            self._psnr = float(np.mean(evaluate(renderer, self._views, VALIDATION_STRIDE)))
            preview = _beside(self._views[0], renderer)
            renderer.close()
        if preview is not None or progress.seconds >= self._next_time:
            self._next_time = progress.seconds + REPORT_EVERY_S
            self._report(TrainingReport(progress, self._psnr, preview))


def _beside(view: View, renderer: NumbaRenderer) -> np.ndarray:
    """An image and what is learnt of it, (h, 2 w, 3) uint8."""
    red, green, blue = (round(255 * value) for value in renderer.metadata.background)
    photo = over_background(view.image, (red, green, blue))
    return np.hstack([photo, renderer.render_view(view.camera.undistorted(), view.cam_from_object).rgb])
