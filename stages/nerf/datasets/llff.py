"""LLFF: poses_bounds.npy beside images, images_4, images_8; photographs that face one way."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from fieldpose.errors import DatasetError
from fieldpose.stages.geometry.cameras import Camera
from fieldpose.stages.geometry.rigid import from_rotation, inverse
from fieldpose.stages.nerf.datasets.assemble import Draft, Holdout, split_of
from fieldpose.stages.nerf.datasets.frames import OPENCV_FROM_OPENGL, relative_name
from fieldpose.stages.nerf.datasets.images import is_image_name, load_array, probe
from fieldpose.stages.nerf.datasets.parsing import checked_rigid
from fieldpose.stages.nerf.datasets.records import ImageRecord

FILE = "poses_bounds.npy"
BOUND_FACTOR = 0.75
_NEAREST = 1e-15
"""Of depths, in whatever unit: what is nearer, or as much farther, is none."""
_ASPECT_TOLERANCE = 0.02


def read_llff(root: Path, holdout: Holdout | None, normalise: bool, downscale: int | None, size: int | None) -> Draft:
    """All images, sorted by name; "auto" holds every eighth out, the first among them.

    Images come from the folder of that `downscale`, else from the smallest that still has `size`, else from the
    largest. With `normalise` the average camera becomes the origin, looking along -z, and the nearest depth becomes
    1 / 0.75, the units of published evaluations (Mildenhall et al., NeRF, 2020); else poses stay as stored.
    DatasetError names the file that is wrong.
    """
    file = root / FILE
    object_from_cam, hwf, depths = read_poses_bounds(file)
    paths = _image_paths(_choose_folder(root, hwf[0], downscale, size))
    if len(paths) != len(object_from_cam):
        raise DatasetError(
            f"{file}: it has {len(object_from_cam)} poses but {paths[0].parent.name} has {len(paths)} images;"
            " there must be one image a pose"
        )
    scale = 1.0
    if normalise:
        scale = 1 / (BOUND_FACTOR * float(depths.min()))
        object_from_cam = recentred(object_from_cam, scale)
    rule: Holdout | None = "every8" if holdout == "auto" else holdout
    records = [
        replace(_record(root, file, path, *pose), split=split_of(i, rule))
        for i, (path, *pose) in enumerate(zip(paths, object_from_cam, hwf, depths * scale, strict=True))
    ]
    unit = "LLFF unit (the nearest depth of the scene is 1.33)" if normalise else "unit of the dataset"
    span = float(depths.min() * scale), float(depths.max() * scale)
    return Draft("llff", records, depths=span, unit=unit, scale=scale)


def read_poses_bounds(file: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """object_from_cam (n, 4, 4) in OpenCV axes, (height, width, focal length) (n, 3), (near, far) (n, 2)."""
    table = load_array(file)
    if table.ndim != 2 or table.shape[1] != 17 or table.dtype.kind not in "fi":
        found = f"{table.dtype} of shape {table.shape}"
        raise DatasetError(f"{file}: expected 17 numbers an image, got {found}; export it again")
    if len(table) == 0:
        raise DatasetError(f"{file}: it has no poses; export it again")
    matrices = table[:, :15].reshape(-1, 3, 5).astype(np.float64)
    down, right, back = matrices[:, :, 0], matrices[:, :, 1], matrices[:, :, 2]
    rows = np.stack([right, down, -back, matrices[:, :, 3]], axis=2)
    object_from_cam = np.concatenate([rows, np.tile([[[0.0, 0.0, 0.0, 1.0]]], (len(rows), 1, 1))], axis=1)
    rigid = np.stack([checked_rigid(m, f"{file}: image {i}") for i, m in enumerate(object_from_cam)])
    hwf, depths = matrices[:, :, 4], table[:, 15:].astype(np.float64)
    _check_numbers(file, hwf, depths)
    return rigid, hwf, depths


def recentred(object_from_cam: np.ndarray, scale: float) -> np.ndarray:
    """Scale the positions, then make the average camera the origin, in OpenGL axes (x right, y up, -z forward)."""
    scaled = object_from_cam.copy()
    scaled[:, :3, 3] *= scale
    forward = _unit(scaled[:, :3, 2].sum(axis=0))
    right = _unit(np.cross(scaled[:, :3, 1].sum(axis=0), forward))
    rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
    average = from_rotation(rotation, scaled[:, :3, 3].mean(axis=0)) @ OPENCV_FROM_OPENGL
    return inverse(average) @ scaled


def _check_numbers(file: Path, hwf: np.ndarray, depths: np.ndarray) -> None:
    bad_camera = ~(np.isfinite(hwf).all(axis=1) & (hwf > 0).all(axis=1))
    near, far = depths.T
    bad_depths = ~((near >= _NEAREST) & (near < far) & (far <= 1 / _NEAREST))
    if bad_camera.any():
        i = int(np.argmax(bad_camera))
        raise DatasetError(f"{file}: image {i}: height, width and focal length must be positive, got {hwf[i].tolist()}")
    if bad_depths.any():
        i = int(np.argmax(bad_depths))
        raise DatasetError(f"{file}: image {i}: expected depths 0 < near < far, got {depths[i].tolist()}")


def _folders(root: Path) -> dict[int, Path]:
    """The image folders by their downscaling."""
    found = {}
    for folder in root.iterdir():
        match = re.fullmatch(r"images(?:_(\d+))?", folder.name)
        if match and folder.is_dir():
            found[int(match[1] or 1)] = folder
    return dict(sorted(found.items()))


def _choose_folder(root: Path, hwf: np.ndarray, downscale: int | None, size: int | None) -> Path:
    folders = _folders(root)
    if not folders:
        raise DatasetError(f"{root}: no folder images, images_4 or images_8; put the images of {FILE} there")
    if downscale is not None:
        if downscale not in folders:
            raise DatasetError(f"{root}: no images at downscale {downscale}; there are {', '.join(map(str, folders))}")
        return folders[downscale]
    enough = [factor for factor in folders if size is not None and max(hwf[0], hwf[1]) / factor >= size]
    return folders[max(enough, default=min(folders))]


def _image_paths(folder: Path) -> list[Path]:
    paths = sorted(path for path in folder.iterdir() if is_image_name(path))
    if not paths:
        raise DatasetError(f"{folder}: it has no images; put the images of {FILE} there")
    return paths


def _record(
    root: Path, file: Path, path: Path, object_from_cam: np.ndarray, hwf: np.ndarray, depths: np.ndarray
) -> ImageRecord:
    header = probe(path)
    height, width, focal = map(float, hwf)
    sx, sy = header.width / width, header.height / height
    if abs(sx / sy - 1) > _ASPECT_TOLERANCE:
        raise DatasetError(
            f"{path}: the image has {header.width}x{header.height} pixels, not the shape of"
            f" {width:g}x{height:g} in {file.name}; restore the image"
        )
    camera = Camera(
        header.width, header.height, focal * sx, focal * sy, (header.width - 1) / 2, (header.height - 1) / 2
    )
    near, far = float(depths[0]), float(depths[1])
    return ImageRecord(relative_name(root, path), path, camera, inverse(object_from_cam), near=near, far=far)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)
