"""Cameras as transforms.json, the file that instant-ngp and nerfstudio read, and as a COLMAP model in text."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from fieldpose.errors import DatasetError
from fieldpose.stages.geometry import Camera, inverse
from fieldpose.stages.nerf.datasets.frames import OPENCV_FROM_OPENGL

PIXEL_CENTRE = 0.5


def transforms_document(
    names: Sequence[str],
    cameras: Sequence[Camera],
    cam_from_object: np.ndarray,
    held_out: Collection[str] | None = None,
    about: Mapping[str, Any] | None = None,
    companions: Sequence[Mapping[str, Any]] | None = None,
) -> dict[str, Any]:
    """What transforms.json says of images by their paths in the dataset, one camera and pose (n, 4, 4) an image.

    Intrinsics stand once where all images share them, else with each image. held_out: the images of the test split;
    None leaves the split to who reads it. about: more of the whole dataset, as metres_per_unit. companions: more of
    each image, as mask_path.
    """
    shared = len(set(cameras)) == 1
    frames: list[dict[str, Any]] = []
    more: Sequence[Mapping[str, Any]] = companions or [{}] * len(names)
    for name, camera, pose, own in zip(names, cameras, cam_from_object, more, strict=True):
        matrix = inverse(pose) @ OPENCV_FROM_OPENGL
        lens = {} if shared else intrinsics(camera)
        frames.append({"file_path": name, **lens, **own, "transform_matrix": matrix.tolist()})
    document: dict[str, Any] = intrinsics(cameras[0]) if shared else {}
    document |= {"camera_model": "OPENCV", **(about or {})}
    if held_out is not None:
        document["train_filenames"] = [name for name in names if name not in held_out]
        document["test_filenames"] = [name for name in names if name in held_out]
    document["frames"] = frames
    return document


def colmap_model(names: Sequence[str], cameras: Sequence[Camera], cam_from_object: np.ndarray) -> dict[str, str]:
    """The files of a COLMAP model in text, without points: one camera and pose (n, 4, 4) an image.

    names: paths below the folder of images; DatasetError for one with a space, at which COLMAP would cut it off.
    """
    from scipy.spatial.transform import Rotation

    spaced = next((name for name in names if any(character.isspace() for character in name)), None)
    if spaced is not None:
        raise DatasetError(f"{spaced!r}: COLMAP's text cannot hold a name with a space; rename it, or write transforms")
    ids = {camera: i + 1 for i, camera in enumerate(dict.fromkeys(cameras))}
    lenses = [f"{i} {_colmap_lens(camera)}" for camera, i in ids.items()]
    posed = []
    for i, (name, camera, pose) in enumerate(zip(names, cameras, cam_from_object, strict=True), 1):
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        numbers = " ".join(repr(float(v)) for v in (w, x, y, z, *pose[:3, 3]))
        posed.append(f"{i} {numbers} {ids[camera]} {name}\n")
    return {
        "cameras.txt": "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n" + "".join(f"{lens}\n" for lens in lenses),
        "images.txt": "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n# POINTS2D[] as (X, Y, POINT3D_ID)\n"
        + "".join(f"{line}\n" for line in posed),
        "points3D.txt": "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n",
    }


def _colmap_lens(camera: Camera) -> str:
    """Model, size and parameters, by the simplest of COLMAP's models with two focal lengths that can hold it."""
    k1, k2, p1, p2, k3 = camera.distortion
    model = "PINHOLE"
    lens: list[float] = []
    if camera.is_distorted:
        model, lens = ("OPENCV", [k1, k2, p1, p2]) if k3 == 0 else ("FULL_OPENCV", [k1, k2, p1, p2, k3, 0.0, 0.0, 0.0])
    numbers = (camera.fx, camera.fy, camera.cx + PIXEL_CENTRE, camera.cy + PIXEL_CENTRE, *lens)
    return " ".join([model, str(camera.width), str(camera.height), *(repr(float(v)) for v in numbers)])


def intrinsics(camera: Camera) -> dict[str, float]:
    """In the terms of transforms.json: the first pixel has its centre at 0.5."""
    k1, k2, p1, p2, k3 = camera.distortion
    return {
        "w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx + PIXEL_CENTRE,
        "cy": camera.cy + PIXEL_CENTRE, "k1": k1, "k2": k2, "p1": p1, "p2": p2, "k3": k3,
    }  # fmt: skip
