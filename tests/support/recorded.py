"""Small recordings of every kind that is read, written to disk as those who made them write them.

Images are those of posed_images, 32x24 pixels, seen from around with the object a little aside, so that no axis of a
pose may be mistaken for another.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from support import posed_images as made

from fieldpose.stages.geometry import Camera, inverse

SIZE = (32, 24)
FULL = (640, 480)


def small(camera: Camera) -> Camera:
    """A camera of 640x480 pixels at the size of these images."""
    return camera.resized(*SIZE)


def text(path: Path, content: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content)


def rows(matrix: np.ndarray) -> str:
    return "".join(" ".join(repr(float(v)) for v in row) + "\n" for row in matrix)


def write_seven_scenes(root: Path, camera: Camera, count: int = 9, turn: int = 0) -> list[np.ndarray]:
    """A sequence, its first pose the one at `turn` of those around the object. Returns the poses."""
    poses = made.poses_around(count + turn)[turn:]
    for i, pose in enumerate(poses):
        made.save(root / f"frame-{i:06d}.color.png", made.picture(camera, pose))
        text(root / f"frame-{i:06d}.pose.txt", rows(inverse(pose)))
    return poses


def quaternion(object_from_cam: np.ndarray) -> list[float]:
    """x, y, z, w."""
    return [float(v) for v in Rotation.from_matrix(object_from_cam[:3, :3]).as_quat()]


def between(start: np.ndarray, end: np.ndarray, share: float) -> np.ndarray:
    """object_from_cam a share of the way: the place along a line, the rotation about one axis."""
    turn = Rotation.from_matrix(start[:3, :3].T @ end[:3, :3]).as_rotvec()
    result = np.eye(4)
    result[:3, :3] = start[:3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()
    result[:3, 3] = (1 - share) * start[:3, 3] + share * end[:3, 3]
    return result


def write_tum(root: Path, camera: Camera, count: int = 9) -> list[np.ndarray]:
    """Poses every 0.08 s, images in between, at a quarter of each step, and depth a little later. Returns the poses."""
    keys = [inverse(pose) for pose in made.poses_around(count + 1)]
    times = [1305031102.175304 + 0.08 * i for i in range(count + 1)]
    head = "# ground truth trajectory\n# timestamp tx ty tz qx qy qz qw\n"
    told = (" ".join(map(repr, (t, *map(float, k[:3, 3]), *quaternion(k)))) for t, k in zip(times, keys, strict=True))
    text(root / "groundtruth.txt", head + "\n".join(told) + "\n")
    poses, images, depths = [], "# color images\n", "# depth maps\n"
    for i in range(count):
        poses.append(inverse(between(keys[i], keys[i + 1], 0.25)))
        at, name = times[i] + 0.02, f"{times[i] + 0.02:.6f}.png"
        made.save(root / "rgb" / name, made.picture(camera, poses[-1]))
        images += f"{at!r} rgb/{name}\n"
        made.save(root / "depth" / name, np.full((camera.height, camera.width), 5000 + 10 * i, np.uint16))
        depths += f"{at + 0.005!r} depth/{name}\n"
    text(root / "rgb.txt", images)
    text(root / "depth.txt", depths)
    return poses


OBJECT, OTHER = 5, 12
MM = 1000.0


def write_bop(root: Path, camera: Camera, count: int = 9, world: bool = True) -> list[np.ndarray]:
    """A scene of two objects, OBJECT second where the number of the image is odd. Returns its poses, in mm.

    The object stands still in its world, if that is told; the point at which the dot is seen is 1000 times made.POINT.
    """
    poses = made.poses_around(count)
    world_from_object = inverse(poses[-1])
    cameras, instances = {}, {}
    for i, pose in enumerate(poses):
        in_mm = pose.copy()
        in_mm[:3, 3] *= MM
        made.save(root / f"rgb/{i:06d}.png", made.picture(camera, pose))
        made.save(root / f"depth/{i:06d}.png", np.full((camera.height, camera.width), 4000 + i, np.uint16))
        shot: dict[str, Any] = {"cam_K": camera.matrix().ravel().tolist(), "depth_scale": 0.5}
        if world:
            cam_from_world = pose @ inverse(world_from_object)
            shot |= {"cam_R_w2c": cam_from_world[:3, :3].ravel().tolist()}
            shot |= {"cam_t_w2c": (MM * cam_from_world[:3, 3]).tolist()}
        cameras[str(i)] = shot
        both = [(OBJECT, in_mm), (OTHER, in_mm @ np.diag([-1.0, -1.0, 1.0, 1.0]))][:: -1 if i % 2 else 1]
        instances[str(i)] = [
            {"obj_id": k, "cam_R_m2c": m[:3, :3].ravel().tolist(), "cam_t_m2c": m[:3, 3].tolist()} for k, m in both
        ]
        for place, (k, _) in enumerate(both):
            mask = np.zeros((camera.height, camera.width), np.uint8)
            mask[: 10 if k == OBJECT else 3] = 255
            made.save(root / f"mask_visib/{i:06d}_{place:06d}.png", mask)
    made.write_json(root / "scene_camera.json", cameras)
    made.write_json(root / "scene_gt.json", instances)
    in_mm = np.stack(poses)
    in_mm[:, :3, 3] *= MM
    return list(in_mm)


def one_object(root: Path) -> None:
    """Leaves OBJECT alone in a scene, as in an onboarding sequence; masks are renamed."""
    content = json.loads((root / "scene_gt.json").read_text())
    for number, several in content.items():
        place = next(i for i, one in enumerate(several) if one["obj_id"] == OBJECT)
        name = f"{int(number):06d}"
        (root / f"mask_visib/{name}_{place:06d}.png").replace(root / f"mask_visib/{name}_{0:06d}.png")
        content[number] = [several[place]]
    made.write_json(root / "scene_gt.json", content)


def write_record3d(
    root: Path, camera: Camera, count: int = 9, each: bool = False, images: str = "rgb"
) -> list[np.ndarray]:
    """An export; the last image was taken away. each: intrinsics for every image, not one K. Returns all poses."""
    poses, told, coefficients = made.poses_around(count), [], []
    for i, pose in enumerate(poses):
        object_from_cam = np.array(made.opengl(pose))
        told.append([*quaternion(object_from_cam), *object_from_cam[:3, 3].tolist()])
        own = shifted(camera, i) if each else camera
        coefficients.append([own.fx, own.fy, own.cx + 0.5, own.cy + 0.5])
        if i < count - 1:
            made.save(root / images / f"{i}.png", made.picture(own, pose))
    fx, fy, cx, cy = coefficients[0]
    content = {"poses": told, "w": camera.width, "h": camera.height, "fps": 60, "K": [fx, 0, 0, 0, fy, 0, cx, cy, 1]}
    made.write_json(root / "metadata.json", content | ({"perFrameIntrinsicCoeffs": coefficients} if each else {}))
    return poses


def shifted(camera: Camera, index: int) -> Camera:
    """As a lens that is held still by moving it."""
    return Camera(camera.width, camera.height, camera.fx + index, camera.fy, camera.cx - 0.25 * index, camera.cy)


def write_polycam(root: Path, camera: Camera, count: int = 9, corrected: bool = True) -> list[np.ndarray]:
    """Raw data of which each image has a camera of its own, and depth of a quarter of its size.

    Poses are those around the object, and y is up in the files. Returns them with z up. If corrected, the images as
    they were taken are there as well, but show nothing.
    """
    poses = made.poses_around(count)
    y_up_from_z_up = np.array([[0.0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    for i, pose in enumerate(poses):
        own, name = shifted(camera, i), f"{1000 + 7 * i}"
        stored = y_up_from_z_up @ np.array(made.opengl(pose))
        content = {f"t_{row}{column}": float(stored[row, column]) for row in range(3) for column in range(4)}
        content |= {"fx": own.fx, "fy": own.fy, "cx": own.cx + 0.5, "cy": own.cy + 0.5, "blur_score": 100.0}
        content |= {"width": own.width, "height": own.height, "timestamp": 1000 + 7 * i}
        for prefix in ("corrected_", "") if corrected else ("",):
            seen = (
                made.picture(own, pose) if prefix or not corrected else np.zeros((own.height, own.width, 3), np.uint8)
            )
            made.save(root / f"keyframes/{prefix}images/{name}.png", seen)
            (root / f"keyframes/{prefix}cameras").mkdir(parents=True, exist_ok=True)
            made.write_json(root / f"keyframes/{prefix}cameras/{name}.json", content)
        made.save(root / f"keyframes/depth/{name}.png", np.full((own.height // 4, own.width // 4), 1250 + i, np.uint16))
    return poses
