"""BOP's scenes: scene_camera.json and scene_gt.json beside rgb, depth and mask_visib; poses are those of an object.

Source: Hodan and others, BOP: benchmark for 6D object pose estimation (2018), and the format's own description.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import msgspec
import numpy as np

from fieldpose.errors import DatasetError
from fieldpose.stages.geometry import Camera, inverse, rotation_error_deg
from fieldpose.stages.geometry.rigid import from_rotation
from fieldpose.stages.nerf.datasets.assemble import Draft, Holdout, split_of
from fieldpose.stages.nerf.datasets.frames import find_image, relative_name
from fieldpose.stages.nerf.datasets.images import probe
from fieldpose.stages.nerf.datasets.intrinsics import checked_camera
from fieldpose.stages.nerf.datasets.parsing import checked_rigid, left_out, listed, matrix, read_json
from fieldpose.stages.nerf.datasets.records import ImageRecord

CAMERAS, POSES = "scene_camera.json", "scene_gt.json"
_IMAGES, _DEPTHS, _MASKS = ("rgb", "gray"), "depth", "mask_visib"
_ONBOARDING = "onboarding"
_OBJECT = re.compile(r"obj_(\d+)")
_STILL_DEG, _STILL_MM = 1.0, 5.0
"""How far an object may seem to move in its world by the errors of its poses alone."""
_T = TypeVar("_T")


class Shot(msgspec.Struct, rename={"k": "cam_K", "world_rotation": "cam_R_w2c", "world_position": "cam_t_w2c"}):
    """Of an image: its camera matrix row by row, mm per step of its depth, and cam_from_world where that is known."""

    k: list[float]
    depth_scale: float | None = None
    world_rotation: list[float] | None = None
    world_position: list[float] | None = None


class Instance(msgspec.Struct, rename={"number": "obj_id", "rotation": "cam_R_m2c", "position": "cam_t_m2c"}):
    """An object in an image: its number and cam_from_object, the rotation row by row and the position in mm."""

    number: int
    rotation: list[float]
    position: list[float]


@dataclass(frozen=True, eq=False)
class _View:
    """An image that shows the object once; `place` is that of the object among the image's instances."""

    number: int
    place: int
    shot: Shot
    cam_from_object: np.ndarray


def scene_of(root: Path) -> tuple[Path, int | None] | None:
    """A scene's folder and the object that a path names: SCENE, or SCENE/obj_000005; None if it is no scene of BOP."""
    if (root / CAMERAS).is_file():
        return root, None
    named = _OBJECT.fullmatch(root.name)
    if named is not None and not root.exists() and (root.parent / CAMERAS).is_file():
        return root.parent, int(named[1])
    return None


def read_bop(scene: Path, wanted: int | None, holdout: Holdout | None) -> Draft:
    """The images that show an object once, sorted by number, in its own frame and in mm.

    wanted: the object's number; None for the only one there is. "auto" holds out every eighth image. The object's
    visible pixels alone are learnt from, unless the scene tells that what is around it stands still with it. (0, 0) is
    the centre of the first pixel. Raises DatasetError.
    """
    shots = _by_number(scene / CAMERAS, read_json(scene / CAMERAS, dict[str, Shot]))
    instances = _by_number(scene / POSES, read_json(scene / POSES, dict[str, list[Instance]]))
    there = sorted({one.number for several in instances.values() for one in several})
    number = _chosen(scene, wanted, there)
    views, notes = _views(scene, shots, instances, number)
    masks = _masks(scene, views)
    learnt, why = _learnt(scene, views, bool(masks))
    rule: Holdout | None = "every8" if holdout == "auto" else holdout
    records = []
    for i, view in enumerate(views):
        path, mask = _image(scene, view.number), masks.get(view.number)
        depth = find_image(scene, f"{_DEPTHS}/{view.number:06d}")
        step = view.shot.depth_scale
        if step is not None and not 0 < step < np.inf:
            raise DatasetError(f"{scene / CAMERAS}: image {view.number}: depth_scale must be positive, got {step}")
        records.append(
            ImageRecord(
                relative_name(scene, path), path, _camera(scene, view, path), view.cam_from_object, split_of(i, rule),
                depth_path=depth, depth_scale=None if depth is None else step,
                mask_path=mask, learnt_path=mask if learnt else None,
            )
        )  # fmt: skip
    return Draft("bop", records, metres_per_unit=0.001, unit="mm", notes=(*notes, f"object {number}: {why}"))


def _by_number(file: Path, content: Mapping[str, _T]) -> dict[int, _T]:
    wrong = next((key for key in content if not key.isdecimal()), None)
    if wrong is not None or not content:
        raise DatasetError(f"{file}: expected the numbers of images, got {wrong!r}; export the scene again")
    return {int(key): value for key, value in content.items()}


def _chosen(scene: Path, wanted: int | None, there: list[int]) -> int:
    if not there:
        raise DatasetError(f"{scene / POSES}: it has no object; give another scene")
    if wanted is None and len(there) == 1:
        return there[0]
    if wanted is None:
        raise DatasetError(
            f"{scene / POSES}: it has {len(there)} objects ({', '.join(map(str, there))}); name one of them as a last"
            f" part of the path, as {scene}/obj_{there[0]:06d}"
        )
    if wanted not in there:
        raise DatasetError(f"{scene / POSES}: it has no object {wanted}, but {', '.join(map(str, there))}")
    return wanted


def _views(
    scene: Path, shots: dict[int, Shot], instances: dict[int, list[Instance]], number: int
) -> tuple[list[_View], tuple[str, ...]]:
    views: list[_View] = []
    none: list[str] = []
    several: list[str] = []
    for image, shot in sorted(shots.items()):
        found = [(place, one) for place, one in enumerate(instances.get(image, ())) if one.number == number]
        if len(found) == 1:
            place, one = found[0]
            where = f"{scene / POSES}: image {image}"
            pose = _posed(where, ("cam_R_m2c", one.rotation), ("cam_t_m2c", one.position))
            views.append(_View(image, place, shot, pose))
        else:
            (several if found else none).append(f"{image:06d}")
    unknown = sorted(instances.keys() - shots.keys())
    if unknown:
        raise DatasetError(f"{scene / CAMERAS}: it has no image {unknown[0]}, but {POSES} has; export the scene again")
    if not views:
        raise DatasetError(
            f"{scene / POSES}: no image shows object {number} once ({len(several)} show it several times)"
        )
    notes = left_out(len(shots), none, f"{POSES} has no pose of object {number}")
    return views, notes + left_out(len(shots), several, f"object {number} is there several times")


def _posed(
    where: str, rotation: tuple[str, list[float] | None], position: tuple[str, list[float] | None]
) -> np.ndarray:
    turned, moved = matrix(where, *rotation, 3, 3), matrix(where, *position, 1, 3)
    return checked_rigid(from_rotation(turned, moved[0]), where)


def _image(scene: Path, number: int) -> Path:
    for folder in _IMAGES:
        found = find_image(scene / folder, f"{number:06d}")
        if found is not None:
            return found
    raise DatasetError(f"{scene / _IMAGES[0] / f'{number:06d}'}: no such image, but {CAMERAS} lists it; restore it")


def _camera(scene: Path, view: _View, path: Path) -> Camera:
    where = f"{scene / CAMERAS}: image {view.number}"
    k = matrix(where, "cam_K", view.shot.k, 3, 3)
    if k[0, 1] != 0 or k[1, 0] != 0 or list(k[2]) != [0, 0, 1]:
        raise DatasetError(f"{where}: cam_K must be fx 0 cx 0 fy cy 0 0 1, got {view.shot.k}; undistort the images")
    header = probe(path)
    return checked_camera(where, header.width, header.height, (k[0, 0], k[1, 1]), (k[0, 2], k[1, 2]))


def _masks(scene: Path, views: list[_View]) -> dict[int, Path]:
    """The masks of the object's visible pixels by image: of all images, or none."""
    found = {view.number: find_image(scene, f"{_MASKS}/{view.number:06d}_{view.place:06d}") for view in views}
    masks = {number: path for number, path in found.items() if path is not None}
    missing = [f"{view.number:06d}_{view.place:06d}" for view in views if view.number not in masks]
    if masks and missing:
        raise DatasetError(f"{scene / _MASKS}: no {listed(missing)}, but others are there; restore them")
    return masks


def _learnt(scene: Path, views: list[_View], masked: bool) -> tuple[bool, str]:
    """Whether the object's pixels alone are learnt from, and why."""
    if masked and any(_ONBOARDING in part for part in scene.resolve().parts):
        return True, f"its visible pixels ({_MASKS}) alone are learnt, as in all onboarding sequences"
    if _stands_still(scene, views):
        return False, "it stands still in its world (cam_R_w2c), so that what is around it is learnt too"
    if masked:
        return True, f"its visible pixels ({_MASKS}) alone are learnt, since what is around it may move against it"
    return False, f"what is around it is learnt as if it stood still with it; there is no {_MASKS} to leave it out by"


def _stands_still(scene: Path, views: list[_View]) -> bool:
    if any(view.shot.world_rotation is None or view.shot.world_position is None for view in views):
        return False
    placed = []
    for view in views:
        where = f"{scene / CAMERAS}: image {view.number}"
        cam_from_world = _posed(where, ("cam_R_w2c", view.shot.world_rotation), ("cam_t_w2c", view.shot.world_position))
        placed.append(inverse(cam_from_world) @ view.cam_from_object)
    first = placed[0]
    return all(
        rotation_error_deg(first, other) < _STILL_DEG and np.linalg.norm(other[:3, 3] - first[:3, 3]) < _STILL_MM
        for other in placed
    )
