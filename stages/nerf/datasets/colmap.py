"""A COLMAP model (binary or text) beside its images, as COLMAP itself and most tools built on it leave them."""

from __future__ import annotations

import os
from pathlib import Path

from fieldpose.errors import DatasetError, GeometryError
from fieldpose.stages.nerf.datasets.assemble import Draft, Holdout, split_of
from fieldpose.stages.nerf.datasets.frames import check_distinct, find_image, relative_name
from fieldpose.stages.nerf.datasets.intrinsics import check_invertible, fitted
from fieldpose.stages.nerf.datasets.records import ImageRecord

MODELS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "colmap", ".")
"""Where a model may be, below a dataset's folder."""
IMAGES = ("images", ".")
_FILES = ({"cameras.bin", "images.bin"}, {"cameras.txt", "images.txt"})


def model_of(root: Path) -> Path | None:
    """The folder of a dataset's model; None if it has none."""
    for name in MODELS:
        folder = root / name
        if folder.is_dir() and any(files <= {path.name for path in folder.iterdir()} for files in _FILES):
            return folder
    return None


def read_colmap(root: Path, model: Path, holdout: Holdout | None) -> Draft:
    """All images that have a pose; "auto" holds out every eighth. Raises DatasetError."""
    from fieldpose.stages.structure.colmap_files import read_model

    try:
        images = read_model(model)
    except GeometryError as error:
        raise DatasetError(str(error)) from error
    if not images:
        raise DatasetError(f"{model}: the model has no image with a pose; map the images again")
    records = []
    for i, image in enumerate(images):
        # Of a name that no file can have it says that there is none.
        whole = [root / place / image.name for place in IMAGES if os.path.isfile(root / place / image.name)]
        tails = (found for place in IMAGES if (found := find_image(root / place, image.name)) is not None)
        path = next(iter(whole), None) or next(tails, None)
        if path is None:
            raise DatasetError(f"{root}: no image {image.name}, but {model} lists it; restore it in {root / IMAGES[0]}")
        split = split_of(i, "every8" if holdout == "auto" else holdout)
        records.append(
            ImageRecord(relative_name(root, path), path, fitted(path, image.camera), image.cam_from_world, split)
        )
    check_distinct(model, records)
    for camera in {record.camera for record in records}:
        try:
            check_invertible(camera)
        except GeometryError as error:
            raise DatasetError(f"{model}: {error}") from error
    return Draft("colmap", records, notes=_notes(root, model))


def _notes(root: Path, model: Path) -> tuple[str, ...]:
    others = [p.name for p in sorted(model.parent.iterdir()) if p.is_dir() and p != model and p.name.isdecimal()]
    if model == root or not model.name.isdecimal() or not others:
        return ()
    return (f"{model} is read; its neighbours are not: {', '.join(others)}",)
