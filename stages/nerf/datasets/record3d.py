"""Record3D's export (EXR + JPG), or its .r3d file unpacked: metadata.json beside numbered images, ARKit's poses.

ARKit's axes are OpenGL's (x right, y up, z back), and its principal points are distances from the image's corner.
"""

from __future__ import annotations

from pathlib import Path

import msgspec

from fieldpose.errors import DatasetError
from fieldpose.stages.geometry import Camera, inverse
from fieldpose.stages.nerf.datasets.assemble import Draft, Holdout, split_of
from fieldpose.stages.nerf.datasets.frames import OPENCV_FROM_OPENGL, relative_name
from fieldpose.stages.nerf.datasets.images import is_image_name
from fieldpose.stages.nerf.datasets.intrinsics import checked_camera, fitted
from fieldpose.stages.nerf.datasets.parsing import left_out, matrix, posed_by_quaternion, read_json
from fieldpose.stages.nerf.datasets.records import ImageRecord

PACKED = ".r3d"
PIXEL_CENTRE = 0.5
_FILES = ("metadata.json", "metadata")
_IMAGES = ("rgb", "EXR_RGBD/rgb", "rgbd")
_DEPTHS = ("depth", "EXR_RGBD/depth")


class Metadata(msgspec.Struct, rename={"k": "K", "coefficients": "perFrameIntrinsicCoeffs"}):
    """Of a recording: qx qy qz qw x y z of each image, and its intrinsics.

    Those are k, a camera matrix column by column for all images, or coefficients, fx fy cx cy of each.
    """

    poses: list[list[float]]
    w: int
    h: int
    k: list[float] | None = None
    coefficients: list[list[float]] | None = None


def metadata_of(root: Path) -> Path | None:
    """The metadata of a folder that is an export; None if it is none."""
    if not any((root / folder).is_dir() for folder in _IMAGES):
        return None
    return next((root / name for name in _FILES if (root / name).is_file()), None)


def packed_in(root: Path) -> Path | None:
    """A recording that is not unpacked: this path, or a file in this folder."""
    if root.suffix == PACKED and root.is_file():
        return root
    return next(iter(sorted(root.glob(f"*{PACKED}"))), None) if root.is_dir() else None


def read_record3d(root: Path, file: Path, holdout: Holdout | None) -> Draft:
    """All images that are there, sorted by number, in metres; "auto" holds out every eighth. Raises DatasetError.

    Depth is stored as EXR or compressed by Apple's LZFSE, and not read.
    """
    metadata = read_json(file, Metadata)
    poses, each = metadata.poses, metadata.coefficients
    if each and len(each) != len(poses):
        raise DatasetError(f"{file}: {len(each)} perFrameIntrinsicCoeffs but {len(poses)} poses; export it again")
    images = _images(root)
    extra = [path.name for number, path in sorted(images.items()) if number >= len(poses)]
    if extra:
        raise DatasetError(f"{file}: it has {len(poses)} poses, none for {extra[0]}; export the recording again")
    rule: Holdout | None = "every8" if holdout == "auto" else holdout
    records = []
    for i, (number, path) in enumerate(sorted(images.items())):
        where = f"{file}: image {number}"
        seven = matrix(where, "its pose", poses[number], 1, 7)[0].tolist()
        object_from_cam = posed_by_quaternion(where, seven[:4], seven[4:]) @ OPENCV_FROM_OPENGL
        camera = fitted(path, _camera(where, metadata, number))
        records.append(
            ImageRecord(relative_name(root, path), path, camera, inverse(object_from_cam), split_of(i, rule))
        )
    missing = [str(number) for number in range(len(poses)) if number not in images]
    notes = left_out(len(poses), missing, "no image")
    if any((root / folder).is_dir() for folder in _DEPTHS):
        notes += ("depth, which is EXR, is not read",)
    return Draft("record3d", records, metres_per_unit=1.0, unit="m", notes=notes)


def _images(root: Path) -> dict[int, Path]:
    for name in _IMAGES:
        if (root / name).is_dir():
            found = {
                int(path.stem): path
                for path in sorted((root / name).iterdir())
                if is_image_name(path) and path.stem.isdecimal()
            }
            if found:
                return found
    raise DatasetError(f"{root}: no images like {_IMAGES[0]}/0.jpg; export the recording as EXR + JPG")


def _camera(where: str, metadata: Metadata, number: int) -> Camera:
    if metadata.coefficients:
        fx, fy, cx, cy = matrix(where, "perFrameIntrinsicCoeffs", metadata.coefficients[number], 1, 4)[0].tolist()
    else:
        k = matrix(where, "K", metadata.k, 3, 3).T
        if k[0, 1] != 0 or k[1, 0] != 0 or k[2].tolist() != [0, 0, 1]:
            raise DatasetError(f"{where}: K must be fx 0 0 0 fy 0 cx cy 1, got {metadata.k}; export it again")
        fx, fy, cx, cy = float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2])
    return checked_camera(where, metadata.w, metadata.h, (fx, fy), (cx - PIXEL_CENTRE, cy - PIXEL_CENTRE))
