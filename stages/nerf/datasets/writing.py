"""Cameras as transforms.json, the file that instant-ngp and nerfstudio read, and as a COLMAP model in text."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

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


def intrinsics(camera: Camera) -> dict[str, float]:
    """In the terms of transforms.json: the first pixel has its centre at 0.5."""
    k1, k2, p1, p2, k3 = camera.distortion
    return {
        "w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx + PIXEL_CENTRE,
        "cy": camera.cy + PIXEL_CENTRE, "k1": k1, "k2": k2, "p1": p1, "p2": p2, "k3": k3,
    }  # fmt: skip
