"""transforms.json as instant-ngp and nerfstudio write it: OpenGL camera axes, COLMAP's pixel coordinates."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Literal

from fieldpose.errors import DatasetError
from fieldpose.stages.nerf.datasets.assemble import Draft, Holdout, split_of
from fieldpose.stages.nerf.datasets.frames import Document, Frame, Listings, find_image, read_document, read_records
from fieldpose.stages.nerf.datasets.records import ImageRecord

FILE = "transforms.json"


def read_transforms(root: Path, holdout: Holdout | None) -> Draft:
    """All images sorted by path; split by the lists in the file, else by holdout ("auto": every second is test).

    Frames with a `sharpness` come from instant-ngp's own script, which lists every frame of a video and leaves the
    deletion of blurred images to the user: such frames may lack their image and are then left out, with a note.
    DatasetError as of frames.read_records.
    """
    file = root / FILE
    document = read_document(file)
    notes = _leave_out_deleted(file, document)
    records = _split(
        file, document, read_records(file, document, "train", pixel_centre=0.5), "odd" if holdout == "auto" else holdout
    )
    return Draft("transforms", records, document.aabb, document.object_aabb, document.metres_per_unit, notes=notes)


def _leave_out_deleted(file: Path, document: Document) -> tuple[str, ...]:
    listings: Listings = {}

    def is_deleted(frame: Frame) -> bool:
        return frame.sharpness is not None and find_image(file.parent, frame.file_path, listings) is None

    total = len(document.frames)
    deleted = [frame.file_path for frame in document.frames if is_deleted(frame)]
    if not deleted:
        return ()
    if len(deleted) == total:
        raise DatasetError(f"{file}: none of its {total} images is there (the first is {deleted[0]}); restore them")
    gone = set(deleted)
    document.frames = [frame for frame in document.frames if frame.file_path not in gone]
    return (f"{file.name}: {len(deleted)} of {total} frames have no image and are left out: {', '.join(deleted)}",)


def _split(file: Path, document: Document, records: list[ImageRecord], holdout: Holdout | None) -> list[ImageRecord]:
    train, test = document.train_filenames, document.test_filenames or document.val_filenames
    ordered = sorted(records, key=lambda record: record.name)
    if train is None and test is None:
        return [replace(record, split=split_of(i, holdout)) for i, record in enumerate(ordered)]
    wanted: dict[str, Literal["train", "test"]] = dict.fromkeys(map(_plain, train or ()), "train")
    wanted |= dict.fromkeys(map(_plain, test or ()), "test")
    unknown = sorted(wanted.keys() - {_plain(frame.file_path) for frame in document.frames})
    if unknown:
        raise DatasetError(f"{file}: {unknown[0]} is in a split but has no frame; take it out or add its frame")
    by_name = {_plain(frame.file_path): record for frame, record in zip(document.frames, records, strict=True)}
    by_name |= {_plain(record.name): record for record in records}
    by_stem = {str(PurePosixPath(name).with_suffix("")): record for name, record in by_name.items()}
    listed = {(by_name.get(name) or by_stem[name]).name: split for name, split in wanted.items()}
    return [replace(record, split=listed[record.name]) for record in ordered if record.name in listed]


def _plain(file_path: str) -> str:
    return PurePosixPath(file_path.replace("\\", "/")).as_posix()
