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
