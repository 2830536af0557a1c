"""A folder `masks` beside the images of a dataset whose files name no masks: what is to be learnt from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from fieldpose.errors import DatasetError
from fieldpose.stages.nerf.datasets.assemble import Draft
from fieldpose.stages.nerf.datasets.frames import relative_name
from fieldpose.stages.nerf.datasets.images import EXTENSIONS, is_image_name, probe
from fieldpose.stages.nerf.datasets.intrinsics import same_shape
from fieldpose.stages.nerf.datasets.parsing import listed
from fieldpose.stages.nerf.datasets.records import ImageRecord

FOLDER = "masks"


def with_masks(root: Path, draft: Draft) -> Draft:
    """With the masks of `masks` folders, in the dataset's or any below it on the way to an image.

    A mask has the path of its image, with or without the folder that the image is in, and its name with any extension,
    or with a second one, as COLMAP has it. Raises DatasetError if some images have none, or two images the same, or one
    has another shape than its image.
    """
    if any(record.learnt_path is not None or record.mask_path is not None for record in draft.records):
        return draft
    masks = find_masks(root, [record.path for record in draft.records])
    if masks is None:
        return draft
    records = [replace(record, learnt_path=masks[record.path]) for record in draft.records]
    _check(records)
    first = masks[draft.records[0].path]
    where = next(folder for folder in first.parents if folder.name == FOLDER)
    note = f"masks of {where} say what is learnt: white is, black is not"
    return replace(draft, records=records, notes=(*draft.notes, note))


def find_masks(root: Path, images: Sequence[Path]) -> dict[Path, Path] | None:
    """The mask of each image, as with_masks finds them; None where there is no folder of masks. Raises DatasetError."""
    ways = {folder for image in images for folder in _ways(root, image)}
    there = {folder: _files(folder / FOLDER) for folder in sorted(ways) if (folder / FOLDER).is_dir()}
    if not there:
        return None
    where = next(iter(there)) / FOLDER
    masks = {image: _mask_of(root, image, there) for image in images}
    without = [relative_name(root, image) for image, mask in masks.items() if mask is None]
    if without:
        raise DatasetError(
            f"{where}: {len(without)} of {len(masks)} images have no mask there: {listed(without)}; add them (white is"
            " learnt), or rename the folder to learn from whole images"
        )
    return {image: mask for image, mask in masks.items() if mask is not None}


def _ways(root: Path, image: Path) -> list[Path]:
    """The folders from the dataset's to that of an image."""
    if not image.is_relative_to(root):
        return [image.parent]
    parts = image.relative_to(root).parts[:-1]
    return [root.joinpath(*parts[:i]) for i in range(len(parts) + 1)]


def _files(folder: Path) -> dict[str, Path]:
    """Images in a folder and below, by their paths there in lower case."""
    return {path.relative_to(folder).as_posix().lower(): path for path in folder.rglob("*") if is_image_name(path)}


def _mask_of(root: Path, image: Path, there: Mapping[Path, Mapping[str, Path]]) -> Path | None:
    for folder in _ways(root, image):
        whole = image.relative_to(folder)
        for below in (whole, Path(*whole.parts[1:])) if len(whole.parts) > 1 else (whole,):
            names = (f"{named.as_posix().lower()}{e}" for named in (below, below.with_suffix("")) for e in EXTENSIONS)
            found = next((name for name in names if name in there.get(folder, {})), None)
            if found is not None:
                return there[folder][found]
    return None


def _check(records: list[ImageRecord]) -> None:
    seen: dict[Path | None, str] = {}
    for record in records:
        if record.learnt_path in seen:
            raise DatasetError(
                f"{record.learnt_path}: it is the mask of {seen[record.learnt_path]} and of {record.name}; put masks"
                " into folders like those of their images"
            )
        seen[record.learnt_path] = record.name
        if record.learnt_path is None:
            continue
        header, image = probe(record.learnt_path), probe(record.path)
        if not same_shape(header, image.width, image.height):
            raise DatasetError(
                f"{record.learnt_path}: the mask has {header.width}x{header.height} pixels, {record.name}"
                f" {image.width}x{image.height}, another shape; make it anew of that image"
            )
