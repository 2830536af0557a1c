"""A dataset as transforms.json, the file that instant-ngp and nerfstudio read, and this project's own reader too."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np

from fieldpose.stages.geometry import Camera, inverse
from fieldpose.stages.nerf.datasets.frames import OPENCV_FROM_OPENGL

PIXEL_CENTRE = 0.5


def transforms_document(
    names: Sequence[str],
    cameras: Sequence[Camera],
    cam_from_object: np.ndarray,
    held_out: Collection[str] = (),
    metres_per_unit: float | None = None,
    object_aabb: np.ndarray | None = None,
) -> dict[str, Any]:
    """What transforms.json says of images by their paths in the dataset, one camera and pose (n, 4, 4) an image.

    Intrinsics stand once where all images share them, else with each image. held_out: the images of the test split.
    object_aabb: (2, 3), the lowest and the highest corner of a box around one object.
    """
    shared = len(set(cameras)) == 1
    frames: list[dict[str, Any]] = []
    for name, camera, pose in zip(names, cameras, cam_from_object, strict=True):
        matrix = inverse(pose) @ OPENCV_FROM_OPENGL
        own = {} if shared else intrinsics(camera)
        frames.append({"file_path": name, **own, "transform_matrix": matrix.tolist()})
    document: dict[str, Any] = intrinsics(cameras[0]) if shared else {}
    document["camera_model"] = "OPENCV"
    if metres_per_unit is not None:
        document["metres_per_unit"] = metres_per_unit
    if object_aabb is not None:
        document["object_aabb"] = object_aabb.tolist()
    if held_out:
        document["train_filenames"] = [name for name in names if name not in held_out]
        document["test_filenames"] = [name for name in names if name in held_out]
    document["frames"] = frames
    return document


def intrinsics(camera: Camera) -> dict[str, float]:
    """In the file's own terms: its first pixel has its centre at 0.5."""
    k1, k2, p1, p2, k3 = camera.distortion
    return {
        "w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx + PIXEL_CENTRE,
        "cy": camera.cy + PIXEL_CENTRE, "k1": k1, "k2": k2, "p1": p1, "p2": p2, "k3": k3,
    }  # fmt: skip
