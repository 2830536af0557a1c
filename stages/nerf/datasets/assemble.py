"""What the readers of all kinds share: splits, and from images with poses to a Dataset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from fieldpose.errors import DatasetError
from fieldpose.stages.nerf.datasets import images
from fieldpose.stages.nerf.datasets.bounds import SceneBounds, box_bounds, object_bounds, too_coarse, unbounded_bounds
from fieldpose.stages.nerf.datasets.records import Dataset, ImageRecord, Kind, PosedCamera, Scene

_TRIED = 4
"""Images with an alpha channel: where all of these are opaque everywhere, it says nothing."""
Holdout = Literal["auto", "odd", "every8"]
Split = Literal["train", "test", "all"]


@dataclass(frozen=True, eq=False)
class Draft:
    """All images of a dataset, both splits, before a split and a size are chosen."""

    kind: Kind
    records: list[ImageRecord]
    aabb: object = None
    object_aabb: object = None
    metres_per_unit: float | None = None
    depths: tuple[float, float] | None = None
    unit: str = "unit of the dataset"
    scale: float = 1.0
    notes: tuple[str, ...] = ()


def split_of(index: int, holdout: Holdout | None) -> Literal["train", "test"]:
    """The split of the image at `index` in the sorted order; None holds nothing out."""
    held_out = index % 2 == 1 if holdout == "odd" else holdout == "every8" and index % 8 == 0
    return "test" if held_out else "train"


def with_cameras(draft: Draft, cameras: Sequence[PosedCamera]) -> Draft:
    """With these cameras instead of its own, one an image, in the order of its records."""
    records = [
        replace(record, camera=given.camera.resized(*_size(record)), cam_from_object=given.cam_from_object)
        for record, given in zip(draft.records, cameras, strict=True)
    ]
    return replace(draft, records=records)


def assemble(root: Path, draft: Draft, split: Split, cut_out: bool = False) -> Dataset:
    """The Dataset of one split; what it says of the scene depends on the training images alone.

    DatasetError if the split is empty, some images have an alpha channel and others none, or one has no mask that is to
    be cut out by it.
    """
    chosen = tuple(record for record in draft.records if split in ("all", record.split))
    if not chosen:
        raise DatasetError(f"{root}: the {split} split is empty; choose another split or holdout, or add images")
    train = [record for record in draft.records if record.split == "train"] or draft.records
    _check_near(root, train)
    if cut_out:
        _check_masks(root, draft.records)
    transparent = cut_out or _is_transparent(draft.records)
    background = images.WHITE if transparent else images.plain_background([partial(_shown, r) for r in train])
    scene: Scene = "object" if background else "unbounded" if draft.aabb is None else "bounded"
    return Dataset(
        root=root,
        kind=draft.kind,
        scene=scene,
        background=background,
        images=chosen,
        bounds=_bounds(scene, draft, train),
        unit=draft.unit,
        has_alpha=transparent,
        cut_out=cut_out,
        scale=draft.scale,
        metres_per_unit=draft.metres_per_unit,
        object_aabb=None if draft.object_aabb is None else np.array(draft.object_aabb, dtype=np.float64),
        notes=draft.notes + (_plain_note(background) if background and not transparent else ()),
    )


def _check_masks(root: Path, records: Sequence[ImageRecord]) -> None:
    without = [record.name for record in records if record.learnt_path is None]
    if without:
        raise DatasetError(
            f"{root}: {len(without)} of {len(records)} images have no mask to cut the object out by (the first is"
            f" {without[0]}); give each one: mask_path in transforms.json, or a masks folder"
        )


def _check_near(root: Path, records: Sequence[ImageRecord]) -> None:
    """DatasetError where numbers of 32 bits, which points have, are too coarse for a scene so far from its origin."""
    coarse = too_coarse(np.stack([record.cam_from_object for record in records]))
    if coarse is not None:
        raise DatasetError(f"{root}: {coarse}; subtract that, as of map coordinates, from all positions")


def _bounds(scene: Scene, draft: Draft, train: list[ImageRecord]) -> SceneBounds:
    poses = [record.cam_from_object for record in train]
    if draft.aabb is not None:
        return box_bounds(np.array(draft.aabb, dtype=np.float64), poses)
    if scene == "object":
        return object_bounds([record.camera for record in train], poses)
    return unbounded_bounds(poses, draft.depths)


def _shown(record: ImageRecord) -> np.ndarray:
    return images.load_pixels(record.path, *_size(record), alpha=False)


def _plain_note(colour: images.Colour) -> tuple[str, ...]:
    return (f"the images show an object on a plain background, RGB {colour}, which is not learnt",)


def _is_transparent(records: list[ImageRecord]) -> bool:
    """Whether the images cut an object out by their alpha channel (one that is opaque everywhere does not)."""
    with_alpha = [record for record in records if images.probe(record.path).has_alpha]
    first = next((record for record in with_alpha[:_TRIED] if not images.is_opaque(record.path)), None)
    if first is None:
        return False
    without = next((record for record in records if record not in with_alpha), None)
    if without is not None:
        raise DatasetError(
            f"{without.path}: the image has no alpha channel, {first.path.name} has one; export them alike"
        )
    return True


def _size(record: ImageRecord) -> tuple[int, int]:
    return record.camera.width, record.camera.height
