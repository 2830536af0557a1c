"""What a dataset reader hands back: posed photographs, read from disk only when they are asked for."""

from __future__ import annotations

import hashlib
import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Literal

import msgspec
import numpy as np

from fieldpose.errors import DatasetError
from fieldpose.stages.geometry import Camera
from fieldpose.stages.nerf.datasets import images
from fieldpose.stages.nerf.datasets.bounds import SceneBounds

Kind = Literal["blender", "transforms", "llff", "colmap", "7scenes", "tum", "bop", "record3d", "polycam"]
Scene = Literal["object", "bounded", "unbounded"]


@dataclass(frozen=True, eq=False)
class ImageRecord:
    """One posed photograph; cam_from_object (4, 4) float64 in OpenCV axes.

    name is the image's path below the dataset. near and far are depths of its content in object units, where known.
    depth_path (numbers to be multiplied by depth_scale) and mask_path lead to ground truth, where there is any.
    learnt_path leads to a mask of what is to be learnt from, where that is not all.
    """

    name: str
    path: Path
    camera: Camera
    cam_from_object: np.ndarray
    split: Literal["train", "test"] = "train"
    near: float | None = None
    far: float | None = None
    depth_path: Path | None = None
    depth_scale: float | None = None
    mask_path: Path | None = None
    learnt_path: Path | None = None


@dataclass(frozen=True, eq=False)
class PosedCamera:
    """A camera, for any size of its images, and its cam_from_object (4, 4)."""

    camera: Camera
    cam_from_object: np.ndarray


@dataclass(frozen=True, eq=False)
class Dataset:
    """Posed photographs of one scene; methods may be called from several threads at once.

    scene: "object" (cut out by the images' alpha channel, if has_alpha, which is their masks, if cut_out; else on a
    plain background), "bounded" (all inside bounds.aabb) or "unbounded". background: what is behind an object, or is to
    be laid behind it. scale: object units per unit of the dataset's own files. object_aabb: (2, 3), where the dataset
    names one object in its scene. notes: what a user should be told, one line each.
    """

    root: Path
    kind: Kind
    scene: Scene
    background: images.Colour | None
    images: tuple[ImageRecord, ...]
    bounds: SceneBounds
    unit: str
    has_alpha: bool = False
    cut_out: bool = False
    scale: float = 1.0
    metres_per_unit: float | None = None
    object_aabb: np.ndarray | None = None
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.images)

    def load_image(self, index: int) -> np.ndarray:
        """Image (h, w, 3 or 4) uint8 RGB(A) at its camera's size. DatasetError if the file cannot be decoded."""
        record = self.images[index]
        width, height = record.camera.width, record.camera.height
        if self.cut_out and record.learnt_path is not None:
            pixels = images.load_pixels(record.path, width, height, alpha=False)
            mask = images.load_mask(record.learnt_path, width, height)
            return np.dstack([pixels, np.where(mask, 255, 0).astype(np.uint8)])
        return images.load_pixels(record.path, width, height, self.has_alpha)

    def load_rgb(self, index: int) -> np.ndarray:
        """Image (h, w, 3) uint8 as a camera would see it: laid over the background where it has alpha."""
        return images.over_background(self.load_image(index), self.background)

    def load_images(self, size: int | None = None, workers: int = 2) -> list[np.ndarray]:
        """All images as load_image gives them, with the longer side at most `size`; decoded by threads."""
        dataset = self if size is None else self.resized(size)
        with ThreadPoolExecutor(max_workers=workers) as pool:
            return list(pool.map(dataset.load_image, range(len(dataset))))

    def load_depth(self, index: int) -> np.ndarray:
        """True depth (h, w) float32 along the optical axis in object units, 0 where unknown.

        DatasetError if the dataset has none for this image.
        """
        record = self.images[index]
        if record.depth_path is None:
            raise DatasetError(f"{record.path}: the dataset has no depth for this image")
        if record.depth_scale is None:
            raise DatasetError(f"{record.depth_path}: the dataset has no depth_scale, the length of one of its steps")
        return images.load_depth(record.depth_path, record.camera.width, record.camera.height, record.depth_scale)

    def load_mask(self, index: int) -> np.ndarray:
        """True mask (h, w) bool of the object. DatasetError if the dataset has none for this image."""
        record = self.images[index]
        if record.mask_path is None:
            raise DatasetError(f"{record.path}: the dataset has no mask for this image")
        return images.load_mask(record.mask_path, record.camera.width, record.camera.height)

    def load_learnt(self, index: int) -> np.ndarray | None:
        """Pixels (h, w) bool of an image that are to be learnt from; None for all. DatasetError."""
        record = self.images[index]
        if record.learnt_path is None or self.cut_out:
            return None
        return images.load_mask(record.learnt_path, record.camera.width, record.camera.height)

    def index(self, name: str) -> int:
        """The place of an image by its name (see find_name)."""
        names = [record.name for record in self.images]
        return names.index(find_name(names, name))

    def resized(self, size: int) -> Dataset:
        """The same dataset with every image's longer side shrunk to `size` pixels; none is enlarged."""
        return replace(self, images=tuple(replace(record, camera=record.camera.shrunk(size)) for record in self.images))

    def content_hash(self) -> str:
        """sha256 (hex) over names, cameras, poses and the bytes of the image files."""
        digest = hashlib.sha256()
        for record in self.images:
            digest.update(
                json.dumps([record.name, record.split, msgspec.structs.asdict(record.camera)], sort_keys=True).encode()
            )
            digest.update(np.ascontiguousarray(record.cam_from_object, dtype="<f8").tobytes())
            digest.update(record.path.read_bytes())
        return digest.hexdigest()


def find_name(names: list[str], wanted: str) -> str:
    """The one of `names` that `wanted` means: equal to it, or alone in ending with it, extension given or not.

    ("train/r_0.png" is found as "r_0", "r_0.png" and "train/r_0".) DatasetError if none or several fit.
    """
    if wanted in names:
        return wanted
    parts = PurePosixPath(wanted).parts
    fitting = [name for name in names if parts in (_tail(name, len(parts)), _tail(_stem(name), len(parts)))]
    if len(fitting) == 1:
        return fitting[0]
    found = f"{len(fitting)} images fit: {', '.join(fitting[:4])}" if fitting else f"names are like {names[0]!r}"
    raise DatasetError(f"no single image is named {wanted!r}; {found}")


def _tail(name: str, count: int) -> tuple[str, ...]:
    return PurePosixPath(name).parts[-count:] if count else ()


def _stem(name: str) -> str:
    return str(PurePosixPath(name).with_suffix(""))
