"""Photographs of a room whose walls are papered, and what cameras in it share, with everything known."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from support.pictures import picture

from fieldpose.stages.geometry import Camera, camera_centres, exp_se3, look_at, rays, rotation_error_deg
from fieldpose.stages.structure.posed import PosedCameras
from fieldpose.stages.structure.tracks import Tracks

HALF = 2.0
"""Of the room's sides."""
_PAPER = 512


def cameras_around(camera: Camera, count: int, seed: int = 3) -> PosedCameras:
    """Cameras on a ring in the room's middle that look outwards and a little to each side, up and down."""
    rng = np.random.default_rng(seed)
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    eyes = np.stack([0.7 * np.cos(angles), 0.7 * np.sin(angles), rng.uniform(-0.4, 0.4, count)], axis=1)
    ahead = np.stack([np.cos(angles + np.pi), np.sin(angles + np.pi), rng.uniform(-0.2, 0.2, count)], axis=1)
    poses = np.stack([look_at(eye, eye + to, (0, 0, 1)) for eye, to in zip(eyes, ahead, strict=True)])
    return PosedCameras((camera,) * count, poses)


def cameras_before_a_wall(camera: Camera, count: int, seed: int = 3) -> PosedCameras:
    """Cameras side by side that face one corner."""
    rng = np.random.default_rng(seed)
    eyes = rng.uniform(-0.8, 0.3, (count, 3))
    return PosedCameras((camera,) * count, np.stack([look_at(eye, (1.6, 1.2, -0.3), (0, 0, 1)) for eye in eyes]))


def disturbed(posed: PosedCameras, degrees: float, length: float, seed: int = 1) -> PosedCameras:
    """Each camera turned by so much about any axis, and moved as far in any direction."""
    rng = np.random.default_rng(seed)
    poses = []
    for pose in posed.cam_from_object:
        axis, way = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        poses.append(exp_se3(np.concatenate([length * way, np.deg2rad(degrees) * axis])) @ pose)
    return PosedCameras(posed.cameras, np.stack(poses))


def photograph(camera: Camera, cam_from_object: np.ndarray) -> np.ndarray:
    """(h, w, 3) uint8: the paper where the ray through each pixel meets the room."""
    origins, directions = (v.astype(np.float64) for v in rays(camera, cam_from_object))
    points, wall = _where_met(origins, directions)
    shape = (camera.height, camera.width)
    image, wall = np.zeros((*shape, 3), np.uint8), wall.reshape(shape)
    for number in np.unique(wall):
        along = np.delete(points, number // 2, axis=1)
        place = ((along / HALF + 1) / 2 * (_PAPER - 1)).astype(np.float32).reshape(*shape, 2)
        paper = cv2.remap(_paper(number), place[..., 0], place[..., 1], cv2.INTER_LINEAR)
        image[wall == number] = paper[wall == number]
    return image


def shared(posed: PosedCameras, count: int, noise_px: float = 0.3, wrong: float = 0.0, seed: int = 0) -> Tracks:
    """So many points of the walls as the cameras see them, each in three images at least; a share is seen wrongly."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-HALF, HALF, (count, 3))
    wall = rng.integers(0, 6, count)
    points[np.arange(count), wall // 2] = np.where(wall % 2 == 0, -HALF, HALF)
    seen = np.stack([_seen(posed, i, points) for i in range(len(posed))], axis=1)
    inside = np.isfinite(seen).all(axis=2)
    kept = inside.sum(axis=1) >= 3
    track, image = np.nonzero(inside[kept])
    pixels = seen[kept][track, image] + noise_px * rng.normal(size=(len(track), 2))
    astray = rng.random(len(track)) < wrong
    pixels[astray] += rng.uniform(-40, 40, (astray.sum(), 2))
    return Tracks(track, image, pixels)


def worst(found: PosedCameras, truth: PosedCameras) -> tuple[float, float]:
    """Greatest errors of poses that are in the same frame: degrees, length."""
    apart = camera_centres(found.cam_from_object) - camera_centres(truth.cam_from_object)
    turned = [rotation_error_deg(a, b) for a, b in zip(found.cam_from_object, truth.cam_from_object, strict=True)]
    return max(turned), float(np.linalg.norm(apart, axis=1).max())


def _seen(posed: PosedCameras, index: int, points: np.ndarray) -> np.ndarray:
    camera, pose = posed.cameras[index], posed.cam_from_object[index]
    in_cam = points @ pose[:3, :3].T + pose[:3, 3]
    in_cam[np.linalg.norm(in_cam[:, :2], axis=1) > in_cam[:, 2]] = np.nan  # where distortion would fold them back
    pixels = camera.project(in_cam)
    with np.errstate(invalid="ignore"):
        inside = ((pixels >= 0) & (pixels <= (camera.width - 1, camera.height - 1))).all(axis=1)
    return np.where(inside[:, None], pixels, np.nan)


def _where_met(origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) of the walls, and which of the six."""
    with np.errstate(divide="ignore"):
        reach = (np.where(directions > 0, HALF, -HALF) - origins) / directions
    axis = np.argmin(np.where(directions == 0, np.inf, reach), axis=1)
    rows = np.arange(len(origins))
    return origins + reach[rows, axis][:, None] * directions, 2 * axis + (directions[rows, axis] > 0)


@cache
def _paper(number: int) -> np.ndarray:
    return picture(number, _PAPER)
