"""Small datasets of every kind, written to disk as other programs write them.

Each image is dark with one bright dot where POINT is seen, so that a reader that misunderstands axes, pixel
centres or sizes is found out by the pictures themselves.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from fieldpose.stages.geometry import Camera, inverse, look_at
from fieldpose.stages.nerf.datasets import Dataset

POINT = np.array([0.25, -0.15, 0.2])
CAMERA = Camera(96, 64, 110.0, 108.0, 46.0, 33.5)
DISTORTED = Camera(96, 64, 110.0, 108.0, 46.0, 33.5, (0.08, -0.05, 0.003, -0.002, 0.01))
OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


def centred(width: int, height: int, focal: float) -> Camera:
    return Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def poses_around(count: int, distance: float = 4.0) -> list[np.ndarray]:
    """cam_from_object of cameras above and around the origin that look at it."""
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False) + 0.3
    eyes = [distance * np.array([np.cos(a) * 0.8, np.sin(a) * 0.8, 0.6]) for a in angles]
    return [look_at(eye, (0, 0, 0), (0, 0, 1)) for eye in eyes]


def poses_ahead(count: int) -> list[np.ndarray]:
    """cam_from_object of cameras side by side that face one way, as LLFF's do."""
    eyes = np.random.default_rng(5).uniform(-0.4, 0.4, (count, 3)) * (1, 1, 0.2) + (0.3, -6, 1)
    return [look_at(eye, eye + np.array((0.02 * i, 6, -0.5)), (0, 0, 1)) for i, eye in enumerate(eyes)]


def seen_at(camera: Camera, cam_from_object: np.ndarray, point: np.ndarray = POINT) -> np.ndarray:
    return camera.project((cam_from_object @ [*point, 1.0])[None, :3])[0]


def picture(camera: Camera, cam_from_object: np.ndarray, channels: int = 3) -> np.ndarray:
    """(h, w, channels) uint8: a round dot at POINT's pixel, on a ramp of red; with alpha, nothing but the dot."""
    away = np.linalg.norm(camera.grid() - seen_at(camera, cam_from_object), axis=1).reshape(camera.height, -1)
    dot = np.rint(255 * np.exp(-((away / 4) ** 2))).astype(np.uint8)
    if channels == 3:
        ramp = np.broadcast_to(np.linspace(0, 90, dot.shape[1]).astype(np.uint8), dot.shape)  # no plain background
        return np.dstack([np.maximum(dot, ramp), dot, dot])
    return np.concatenate([np.full((*dot.shape, 3), 200, np.uint8), dot[..., None]], axis=2)


def dot_in(image: np.ndarray) -> np.ndarray:
    """(x, y) of the middle of the dot."""
    weight = image[..., -1].astype(np.float64) ** 2
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    return np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()


def worst_dot_px(dataset: Dataset, point: np.ndarray = POINT) -> float:
    """How far from its projection the point is in the loaded images, at most."""
    return max(
        float(np.linalg.norm(dot_in(image) - seen_at(record.camera, record.cam_from_object, point)))
        for image, record in zip(dataset.load_images(), dataset.images, strict=True)
    )


def assert_poses(dataset: Dataset, poses: Sequence[np.ndarray], within: float = 1e-6) -> None:
    found = np.stack([record.cam_from_object for record in dataset.images])
    np.testing.assert_allclose(found, np.stack(poses), atol=within)


def save(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)


def opengl(cam_from_object: np.ndarray) -> list[list[float]]:
    """What Blender and instant-ngp store."""
    return (inverse(cam_from_object) @ OPENGL_FROM_OPENCV).tolist()


def write_json(path: Path, content: Any) -> None:
    path.write_text(json.dumps(content))


def edit_json(path: Path, **changes: Any) -> None:
    write_json(path, json.loads(path.read_text()) | changes)


def edit_frame(path: Path, index: int, **changes: Any) -> None:
    content = json.loads(path.read_text())
    content["frames"][index] |= changes
    write_json(path, content)


def write_blender(root: Path, camera: Camera, channels: int = 4, counts: Sequence[int] = (6, 3)) -> list[np.ndarray]:
    """Like NeRF-synthetic: the angle of view only, no extensions. Returns the poses, those for training first."""
    poses = poses_around(sum(counts))
    start = 0
    for split, count in zip(("train", "test"), counts, strict=True):
        frames = []
        for i, pose in enumerate(poses[start : start + count]):
            save(root / split / f"r_{i}.png", picture(camera, pose, channels))
            frames.append({"file_path": f"./{split}/r_{i}", "rotation": 0.01, "transform_matrix": opengl(pose)})
        angle = 2 * np.arctan(camera.width / 2 / camera.fx)
        write_json(root / f"transforms_{split}.json", {"camera_angle_x": angle, "frames": frames})
        start += count
    return poses


def intrinsics(camera: Camera, pixel_centre: float = 0.5) -> dict[str, float]:
    """As transforms.json spells them; COLMAP's first pixel has its centre at 0.5."""
    names = dict(zip(("k1", "k2", "p1", "p2", "k3"), camera.distortion, strict=True))
    size = {"w": float(camera.width), "h": float(camera.height), "fl_x": camera.fx, "fl_y": camera.fy}
    return size | names | {"cx": camera.cx + pixel_centre, "cy": camera.cy + pixel_centre}


def write_transforms(root: Path, camera: Camera, count: int = 7) -> list[np.ndarray]:
    """Like instant-ngp's: intrinsics for the whole file. Returns the poses."""
    poses = poses_around(count)
    frames = []
    for i, pose in enumerate(poses):
        save(root / f"images/{i:04d}.png", picture(camera, pose))
        frames.append({"file_path": f"images/{i:04d}.png", "transform_matrix": opengl(pose)})
    write_json(root / "transforms.json", intrinsics(camera) | {"camera_angle_x": 0.5, "frames": frames})
    return poses


def llff_table(poses: Sequence[np.ndarray], camera: Camera, depths: Sequence[float]) -> np.ndarray:
    """poses_bounds: rotation as columns down, right, backwards; then position; then height, width, focal length."""
    rows = []
    for pose in poses:
        right, down, forward, position = inverse(pose)[:3].T
        columns = [down, right, -forward, position, (camera.height, camera.width, camera.fx)]
        rows.append([*np.stack(columns, axis=1).ravel(), *depths])
    return np.array(rows)


def write_llff(root: Path, camera: Camera, count: int = 10, factors: Sequence[int] = (1, 4)) -> list[np.ndarray]:
    """Returns the poses; the depths are 3 and 30."""
    poses = poses_ahead(count)
    for factor in factors:
        small = camera.resized(camera.width // factor, camera.height // factor)
        for i, pose in enumerate(poses):
            save(root / ("images" if factor == 1 else f"images_{factor}") / f"image{i:03d}.png", picture(small, pose))
    np.save(root / "poses_bounds.npy", llff_table(poses, camera, (3.0, 30.0)))
    return poses
