"""A dataset of any kind that is read, written anew as transforms.json or a COLMAP model with the images beside it."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from PIL import Image

from fieldpose.errors import DatasetError, GeometryError, OutputError
from fieldpose.stages.nerf.datasets.records import Dataset, ImageRecord
from fieldpose.stages.nerf.datasets.transforms import FILE
from fieldpose.stages.nerf.datasets.writing import transforms_document

Target = Literal["transforms", "colmap"]
IMAGES, DEPTHS, MASKS, OUTLINES = "images", "depth", "masks", "outlines"
"""Folders of what is written: outlines are true masks of an object, masks say what is learnt."""
MODEL = "sparse/0"
PARTIAL = ".partial"


@dataclass(frozen=True)
class Converted:
    """What became of a dataset: the images written, those of them held out, and what there was no place for."""

    images: int
    held_out: int
    lost: tuple[str, ...]


def convert(dataset: Dataset, out: Path, to: Target, images: bool = True) -> Converted:
    """Write all images of a dataset, at the size of their files, into a folder that is empty or not there.

    They are copied below `images`, unless images is False, by the paths that they have below the folder that holds all
    of them. Frame and unit are the dataset's. Everything is written beside the folder first, so that it is whole or not
    there. Raises DatasetError and OutputError.
    """
    out = out.absolute()
    partial = out.with_name(out.name + PARTIAL)
    if partial.exists():
        raise OutputError(f"{partial}: an unfinished conversion is in the way; remove it")
    below = _below(dataset.images)
    try:
        partial.mkdir(parents=True)
        written = (_write_transforms if to == "transforms" else _write_colmap)(dataset, below, partial)
        for record, name in zip(dataset.images, below, strict=True):
            if images:
                _copy(record.path, partial / IMAGES / name)
        os.replace(partial, out)
    except OSError as error:
        raise OutputError(f"{out}: cannot be written: {error.strerror or error}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return written


def _below(records: Sequence[ImageRecord]) -> list[str]:
    """Their paths below the folder that holds all of them, with / between parts."""
    paths = [os.path.abspath(record.path) for record in records]
    common = os.path.commonpath([os.path.dirname(path) for path in paths])
    return [Path(os.path.relpath(path, common)).as_posix() for path in paths]


def _write_transforms(dataset: Dataset, below: Sequence[str], folder: Path) -> Converted:
    names = [f"{IMAGES}/{name}" for name in below]
    held_out = {name for name, record in zip(names, dataset.images, strict=True) if record.split == "test"}
    companions = [_companions(record, name, folder) for name, record in zip(below, dataset.images, strict=True)]
    about: dict[str, Any] = {}
    if dataset.metres_per_unit is not None:
        about["metres_per_unit"] = dataset.metres_per_unit
    if dataset.scene != "unbounded":
        about["aabb"] = dataset.bounds.aabb.tolist()
    if dataset.object_aabb is not None:
        about["object_aabb"] = dataset.object_aabb.tolist()
    cameras = [record.camera for record in dataset.images]
    document = transforms_document(names, cameras, _poses(dataset), held_out, about, companions)
    (folder / FILE).write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    deep = any(record.near is not None for record in dataset.images)
    return Converted(len(names), len(held_out), ("the nearest and farthest depths",) if deep else ())


def _companions(record: ImageRecord, name: str, folder: Path) -> dict[str, Any]:
    """What an image's frame says of its depth and masks, which are copied."""
    found: dict[str, Any] = {}
    for key, place, path in (
        ("depth_file_path", DEPTHS, record.depth_path),
        ("mask_path", MASKS, record.learnt_path),
        ("mask_file_path", OUTLINES, record.mask_path),
    ):
        if path is not None:
            found[key] = f"{place}/{name}{path.suffix}"
            _copy(path, folder / found[key])
    if record.depth_path is not None and record.depth_scale is not None:
        found["depth_scale"] = record.depth_scale
    return found


def _write_colmap(dataset: Dataset, below: Sequence[str], folder: Path) -> Converted:
    model = folder / MODEL
    model.mkdir(parents=True)
    for name, text in _model(dataset, below).items():
        (model / name).write_text(text, encoding="utf-8")
    if any(record.learnt_path is not None for record in dataset.images):
        for name, record in zip(below, dataset.images, strict=True):
            _write_mask(record, folder / MASKS / f"{name}.png")
    return Converted(len(below), 0, tuple(_lost_to_colmap(dataset)))


def _model(dataset: Dataset, below: Sequence[str]) -> dict[str, str]:
    # It brings COLMAP, which takes a while to import.
    from fieldpose.stages.structure.colmap import ModelImage, model_text

    images = [
        ModelImage(name, record.camera, record.cam_from_object)
        for name, record in zip(below, dataset.images, strict=True)
    ]
    try:
        return model_text(images)
    except GeometryError as error:
        raise DatasetError(f"{dataset.root}: {error}") from error


def _write_mask(record: ImageRecord, path: Path) -> None:
    """COLMAP's masks are of all images or of none, and PNG."""
    if record.learnt_path is not None and record.learnt_path.suffix.lower() == ".png":
        _copy(record.learnt_path, path)
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    if record.learnt_path is None:
        Image.fromarray(np.full((record.camera.height, record.camera.width), 255, np.uint8)).save(path)
        return
    with Image.open(record.learnt_path) as mask:
        mask.convert("L").save(path)


def _lost_to_colmap(dataset: Dataset) -> Iterator[str]:
    if any(record.split == "test" for record in dataset.images):
        yield "which images are held out"
    if dataset.metres_per_unit is not None:
        yield "the length of the unit in metres"
    if dataset.scene == "bounded" or dataset.object_aabb is not None:
        yield "boxes"
    if any(record.depth_path is not None or record.mask_path is not None for record in dataset.images):
        yield "true depths and outlines"
    if any(record.near is not None for record in dataset.images):
        yield "the nearest and farthest depths"


def _poses(dataset: Dataset) -> np.ndarray:
    return np.stack([record.cam_from_object for record in dataset.images])


def _copy(path: Path, to: Path) -> None:
    to.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(path, to)
