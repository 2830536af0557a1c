"""Small recordings of every kind that is read, written to disk as those who made them write them.

Images are those of posed_images, 32x24 pixels, seen from around with the object a little aside, so that no axis of a
pose may be mistaken for another.
"""

from __future__ import annotations

from pathlib import Path

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
