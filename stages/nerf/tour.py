"""The way of a camera that shows what a field has learnt: around it, or along the places that it was seen from."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from fieldpose.stages.geometry import (
    Camera,
    Limit,
    camera_centres,
    look_at,
    nearest_point_to_axes,
    nearest_rigid,
    pairwise,
)
from fieldpose.stages.nerf.metadata import FieldMetadata

_LARGEST_GAP = np.pi / 2
_MOST_VIEWS = 200
_HOP_DEG = 60.0
"""An angle between cameras that counts as much as the distance between the mean of all and a usual one."""
_FINE, _SMOOTH = 256, 0.08
_UPRIGHT = 0.05


@dataclass(frozen=True)
class Tour:
    """An undistorted camera whose sides are even, as videos need them, its poses (4, 4), and which each frame shows."""

    camera: Camera
    poses: list[np.ndarray]
    order: list[int]


def tour(metadata: FieldMetadata, frames: int, longer_side: int) -> Tour:
    """A full circle where the training views surround what is in a box, at their median height and distance.

    Else to and fro along training views, from one end of them to the other. frames: an even number. The field must tell
    of training views.
    """
    chosen = np.unique(np.linspace(0, len(metadata.cameras) - 1, min(_MOST_VIEWS, len(metadata.cameras))).astype(int))
    poses = np.array([metadata.cameras[i].pose for i in chosen])
    camera = _even(metadata.cameras[0].camera.undistorted().shrunk(longer_side))
    if metadata.space.corners is not None and _gap(poses) < _LARGEST_GAP:
        return Tour(camera, _circle(poses, frames), list(range(frames)))
    there = list(range(frames // 2 + 1))
    return Tour(camera, _along(poses, len(there)), there + there[-2:0:-1])


def _even(camera: Camera) -> Camera:
    return camera.resized(max(camera.width // 2 * 2, 2), max(camera.height // 2 * 2, 2))


def _around(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the cameras look at (3,), axes (3, 3) of which the last is up, and the cameras from there in them (n, 3).

    Up is across the cameras' horizontal axes, as far as these tell it, and on the whole towards the images' tops.
    """
    middle = nearest_point_to_axes(list(poses))
    across = np.einsum("ni,nj->ij", poses[:, 0, :3], poses[:, 0, :3]) / len(poses)
    z = np.linalg.solve(across + _UPRIGHT * np.eye(3), -poses[:, 1, :3].mean(axis=0))
    z /= max(float(np.linalg.norm(z)), 1e-12)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= max(float(np.linalg.norm(x)), 1e-12)
    axes = np.stack([x, np.cross(z, x), z])
    return middle, axes, (camera_centres(poses) - middle) @ axes.T


def _gap(poses: np.ndarray) -> float:
    """The largest angle about the upright axis without a camera, in radians."""
    _, _, out = _around(poses)
    angles = np.sort(np.arctan2(out[:, 1], out[:, 0]))
    return float(np.diff(np.append(angles, angles[0] + 2 * np.pi)).max())


def _circle(poses: np.ndarray, frames: int) -> list[np.ndarray]:
    middle, axes, out = _around(poses)
    distance = np.median(np.linalg.norm(out, axis=1))
    height = np.median(np.arctan2(out[:, 2], np.linalg.norm(out[:, :2], axis=1)))
    turns = np.arctan2(out[0, 1], out[0, 0]) + np.linspace(0, 2 * np.pi, frames, endpoint=False)
    level = np.stack([np.cos(turns), np.sin(turns), np.full(frames, np.tan(height))], axis=1)
    return [look_at(middle + eye @ axes, middle, axes[2]) for eye in distance * np.cos(height) * level]


def _along(poses: np.ndarray, frames: int) -> list[np.ndarray]:
    """A smooth way along poses, slow at its ends, from one of them by small hops to the one farthest from it."""
    # Half a second to import, which reading a field does without.
    from scipy.ndimage import gaussian_filter1d
    from scipy.spatial.transform import Rotation, Slerp

    centres = camera_centres(poses)
    spread = float(np.median(np.linalg.norm(centres - centres.mean(axis=0), axis=1))) or 1.0
    apart = pairwise(poses, poses, Limit(_HOP_DEG, spread))
    stops = _by_small_hops(apart)
    at = np.cumsum([0.0, *(max(apart[a, b], 1e-6) for a, b in itertools.pairwise(stops))])
    fine = np.linspace(0, at[-1], _FINE)
    turns = (
        Slerp(at, Rotation.from_matrix(poses[stops, :3, :3]))(fine).as_matrix() if len(stops) > 1 else poses[:1, :3, :3]
    )
    keys = np.stack([np.interp(fine, at, column) for column in centres[stops].T], axis=1)
    way = np.concatenate([keys, np.broadcast_to(turns, (_FINE, 3, 3)).reshape(_FINE, 9)], axis=1)
    way = gaussian_filter1d(way, _SMOOTH * _FINE, axis=0, mode="nearest")
    when = (1 - np.cos(np.linspace(0, np.pi, frames))) / 2 * at[-1]
    shown = np.stack([np.interp(when, fine, column) for column in way.T], axis=1)
    return [_pose(centre, turn.reshape(3, 3)) for centre, turn in zip(shown[:, :3], shown[:, 3:], strict=True)]


def _pose(centre: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """cam_from_object at a centre, turned as nearly as can be by what is no rotation any more."""
    pose = np.eye(4)
    pose[:3, :3] = turn
    pose = nearest_rigid(pose)
    pose[:3, 3] = -pose[:3, :3] @ centre
    return pose


def _by_small_hops(apart: np.ndarray) -> list[int]:
    """The way through a graph of (n, n) distances between its ends, of which no hop is longer than it must be."""
    from scipy.sparse.csgraph import dijkstra

    # Squares make two hops shorter than one of the same length; what is almost 0 would be no connection.
    cost = np.maximum(apart, 1e-2) ** 2
    first = int(dijkstra(cost, indices=int(apart.sum(axis=1).argmin())).argmax())
    length, before = dijkstra(cost, indices=first, return_predecessors=True)
    way = [int(length.argmax())]
    while way[-1] != first:
        way.append(int(before[way[-1]]))
    return way[::-1]
