"""The JSON of posed images that instant-ngp, nerfstudio and NeRF-synthetic share, read and checked."""

from __future__ import annotations

import difflib
import os
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np

from fieldpose.errors import DatasetError
from fieldpose.stages.geometry.rigid import inverse
from fieldpose.stages.nerf.datasets.images import EXTENSIONS, ImageHeader, probe
from fieldpose.stages.nerf.datasets.intrinsics import Intrinsics, camera_of
from fieldpose.stages.nerf.datasets.parsing import checked_rigid, converted, parse_json
from fieldpose.stages.nerf.datasets.records import ImageRecord

OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
NOT_OURS = frozenset({"scale", "offset", "aabb_scale", "applied_transform", "applied_scale", "time"})
"""Keys that other programs write, alike to some of these files' own."""
_A_LENS = "undistort the images to a pinhole camera first, or take the key out if it means nothing"
_OTHER_AXES = "write poses in OpenGL's camera axes (x right, y up, z back) and take the key out"
UNSUPPORTED = {
    **dict.fromkeys(("k5", "k6", "rolling_shutter", "latlong", "equirectangular", "orthographic"), _A_LENS),
    **dict.fromkeys((f"ftheta_p{i}" for i in range(5)), _A_LENS),
    **dict.fromkeys(("from_mitsuba", "from_na"), _OTHER_AXES),
}
"""Keys, of instant-ngp the most, that say what this reader has no model for unless they say nothing; and what to do."""
_MISSPELT = 0.74
_MATTER = ("transform_matrix", "frames", "aabb", "object_aabb", "metres_per_unit")
_OF_OTHERS = ("_id", "_label", "_path", "_name", "_index")
Box = tuple[tuple[float, float, float], tuple[float, float, float]]


class Frame(Intrinsics, kw_only=True):
    """One posed image; its own intrinsics, where given, override the file's."""

    file_path: str
    transform_matrix: list[list[float]]
    sharpness: float | None = None
    depth_file_path: str | None = None
    depth_scale: float | None = None
    mask_file_path: str | None = None
    mask_path: str | None = None


class Document(Intrinsics, kw_only=True):
    """A whole file."""

    frames: list[Frame]
    aabb: Box | None = None
    object_aabb: Box | None = None
    metres_per_unit: float | None = None
    depth_scale: float | None = None
    train_filenames: list[str] | None = None
    val_filenames: list[str] | None = None
    test_filenames: list[str] | None = None


def read_document(file: Path) -> Document:
    """Parse and check a file of frames. DatasetError if it is no such JSON or holds no frame."""
    content = parse_json(file)
    document = converted(file, content, Document)
    if not document.frames:
        raise DatasetError(f"{file}: it has no frames; export the dataset again")
    check_keys(file, "", content, Document)
    for i, frame in enumerate(content["frames"]):
        check_keys(file, f"frame {i}: ", frame, Frame)
    _check_document(file, document)
    return document


def check_keys(file: Path, where: str, content: Mapping[str, object], known: type[Intrinsics]) -> None:
    """DatasetError for a key that is not known and whose name or number would change the cameras, were it known.

    Other keys, which other programs write for themselves, are theirs.
    """
    names = set(known.__struct_fields__)
    matter = sorted(names & {*Intrinsics.__struct_fields__, *_MATTER})
    for key in sorted(content.keys() - names - NOT_OURS):
        if key.endswith(_OF_OTHERS) or key.startswith("n_"):
            continue
        meant = difflib.get_close_matches(key, matter, 1, _MISSPELT)
        if meant:
            raise DatasetError(f"{file}: {where}{key!r} is no key of this file; is {meant[0]!r} meant?")
    for key in sorted(UNSUPPORTED.keys() & content.keys()):
        if content[key] not in (0, 0.0, None, [], False):
            raise DatasetError(f"{file}: {where}{key} is {content[key]!r}, which is not supported; {UNSUPPORTED[key]}")


Listings = dict[Path, dict[str, Path]]
"""What stands in folders, by names in lower case: for who looks for many images that may not be there."""


def find_image(root: Path, file_path: str, listings: Listings | None = None) -> Path | None:
    """The image that a frame names; None if there is none.

    Its extension may be left out, or differ in upper and lower case, and the path may begin in another folder than the
    dataset's, as where a converter was run: then its longest end that leads to a file counts.
    """
    parts = PurePosixPath(file_path.replace("\\", "/")).parts
    for first in range(len(parts)):
        try:
            found = _image_at(root.joinpath(*parts[first:]), {} if listings is None else listings)
        except (OSError, ValueError):  # no name that a file can have, as one that is empty or too long
            continue
        if found is not None:
            return found
    return None


def _image_at(path: Path, listings: Listings) -> Path | None:
    candidates = (path, *(path.with_name(path.name + extension) for extension in EXTENSIONS))
    found = next((candidate for candidate in candidates if candidate.is_file()), None)
    if found is None and path.parent not in listings:
        there = sorted(path.parent.iterdir(), reverse=True) if path.parent.is_dir() else []
        listings[path.parent] = {p.name.lower(): p for p in there}
    if found is None:
        alike = (listings[path.parent].get(candidate.name.lower()) for candidate in candidates)
        found = min((p for p in alike if p is not None and p.is_file()), default=None)
    return found


def read_records(
    file: Path, document: Document, split: Literal["train", "test"], pixel_centre: float
) -> list[ImageRecord]:
    """The images of a document, at full size, in its order; pixel_centre: where its first pixel's centre lies.

    DatasetError if an image is missing or has another size than stated, or a pose is not rigid.
    """
    listings: Listings = {}
    found = [_found(file, frame, listings) for frame in document.frames]
    _check_names(file, [relative_name(file.parent, path) for path in found])
    headers = [probe(path) for path in found]
    _check_sizes(file, document, found, headers)
    records = [
        _record(file, document, frame, path, header, split, pixel_centre)
        for frame, path, header in zip(document.frames, found, headers, strict=True)
    ]
    return records


def check_distinct(file: Path | str, records: Sequence[ImageRecord]) -> None:
    """DatasetError if one image is listed twice."""
    _check_names(file, [record.name for record in records])


def _check_names(file: Path | str, names: Sequence[str]) -> None:
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise DatasetError(f"{file}: {name} is listed twice; take one of its frames out")
        seen.add(name)


def relative_name(root: Path, path: Path) -> str:
    """The path of an image below its dataset, with / between its parts."""
    return path.relative_to(root).as_posix() if path.is_relative_to(root) else path.as_posix()


def _check_document(file: Path, document: Document) -> None:
    for name in ("aabb", "object_aabb"):
        box = getattr(document, name)
        if box is not None and not (np.isfinite(box).all() and np.less(box[0], box[1]).all()):
            raise DatasetError(f"{file}: {name} must be its lowest and its highest corner, got {box}")
    for name in ("metres_per_unit", "depth_scale"):
        number = getattr(document, name)
        if number is not None and not 0 < number < np.inf:
            raise DatasetError(f"{file}: {name} must be positive, got {number}")


def _found(file: Path, frame: Frame, listings: Listings) -> Path:
    path = find_image(file.parent, frame.file_path, listings)
    if path is None:
        raise DatasetError(
            f"{file.parent / frame.file_path}: no such image, but {file.name} lists it;"
            " restore the image or take its frame out"
        )
    return path


def _check_sizes(file: Path, document: Document, paths: list[Path], headers: list[ImageHeader]) -> None:
    """Images may differ in size only where each frame says its own size or intrinsics."""
    for frame, path, header in zip(document.frames, paths, headers, strict=True):
        stated = (frame.w or document.w or header.width, frame.h or document.h or header.height)
        if stated != (header.width, header.height):
            raise DatasetError(
                f"{path}: the image has {header.width}x{header.height} pixels but {file.name} says"
                f" {stated[0]:g}x{stated[1]:g}; resize the image or give its frame its own w, h and intrinsics"
            )
        shared = frame.fl_x is None and frame.camera_angle_x is None
        if shared and (header.width, header.height) != (headers[0].width, headers[0].height):
            raise DatasetError(
                f"{path}: the image has {header.width}x{header.height} pixels, others have {headers[0].width}x"
                f"{headers[0].height}; resize it or give its frame its own intrinsics in {file.name}"
            )


def _record(
    file: Path, document: Document, frame: Frame, path: Path, header: ImageHeader,
    split: Literal["train", "test"], pixel_centre: float,
) -> ImageRecord:  # fmt: skip
    where = f"{file}: frame {frame.file_path}"
    depth_path = _companion(file, frame.depth_file_path)
    depth_scale = frame.depth_scale if frame.depth_scale is not None else document.depth_scale
    if depth_scale is not None and not 0 < depth_scale < np.inf:
        raise DatasetError(f"{where}: depth_scale, the length of one step, must be positive, got {depth_scale}")
    return ImageRecord(
        name=relative_name(file.parent, path),
        path=path,
        camera=camera_of(document, frame, header, pixel_centre, where),
        cam_from_object=OPENCV_FROM_OPENGL @ inverse(checked_rigid(_matrix(frame, where), where)),
        split=split,
        depth_path=depth_path,
        depth_scale=depth_scale,
        mask_path=_companion(file, frame.mask_file_path),
        learnt_path=_companion(file, frame.mask_path),
    )


def _matrix(frame: Frame, where: str) -> np.ndarray:
    rows = frame.transform_matrix
    if len(rows) not in (3, 4) or any(len(row) != 4 for row in rows):
        raise DatasetError(f"{where}: transform_matrix must be 4x4, got {len(rows)} rows of {[len(r) for r in rows]}")
    return np.array(rows if len(rows) == 4 else [*rows, [0, 0, 0, 1]], dtype=np.float64)


def _companion(file: Path, file_path: str | None) -> Path | None:
    if file_path is None:
        return None
    path = file.parent / file_path.replace("\\", "/")
    if not os.path.isfile(path):
        raise DatasetError(f"{path}: no such file, but {file.name} lists it; restore it or take its entry out")
    return path
