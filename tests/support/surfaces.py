"""Surfaces of known shape: their views, a field that holds a ball, and files of surfaces read plainly."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from fieldpose.stages.geometry import Camera, camera_centre, look_at, rays
from fieldpose.stages.nerf.config import FieldConfig
from fieldpose.stages.nerf.field import Field, learnt_shapes, net_of
from fieldpose.stages.nerf.metadata import FieldMetadata, Space, TrainingCamera
from fieldpose.stages.nerf.surface.kernels import DepthViews
from fieldpose.stages.nerf.surface.views import facing

RED = (230, 77, 26)
BALL_RADIUS = 0.6
_CAMERA = Camera(96, 96, 130.0, 130.0, 47.5, 47.5)


def around(count: int, distance: float = 4.0) -> list[np.ndarray]:
    """cam_from_object of cameras spread over a sphere (Fibonacci's), looking at its middle."""
    i = np.arange(count) + 0.5
    z, turn = 1 - 2 * i / count, np.pi * (1 + 5**0.5) * i
    across = np.sqrt(1 - z * z)
    eyes = distance * np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1)
    return [look_at(eye, (0, 0, 0), (0.1, 0.2, 0.97)) for eye in eyes]


def views_of(
    distance: Callable[[np.ndarray], np.ndarray], poses: list[np.ndarray], camera: Camera = _CAMERA
) -> DepthViews:
    """Exact depth of what a signed distance tells, by sphere tracing; colours are the directions of normals."""
    depths = np.stack([_traced(distance, camera, pose) for pose in poses])
    return DepthViews(
        size=np.array([(camera.width, camera.height)] * len(poses)),
        lens=np.array([(camera.fx, camera.fy, camera.cx, camera.cy)] * len(poses), np.float32),
        turn=np.array([pose[:3, :3] for pose in poses], np.float32),
        shift=np.array([pose[:3, 3] for pose in poses], np.float32),
        depth=depths,
        facing=np.stack([np.rint(255 * facing(camera, depth)).astype(np.uint8) for depth in depths]),
        rgb=np.tile(np.array(RED, np.uint8), (*depths.shape, 1)),
    )


def _traced(distance: Callable[[np.ndarray], np.ndarray], camera: Camera, pose: np.ndarray) -> np.ndarray:
    origins, directions = rays(camera, pose)
    length = np.linalg.norm(directions, axis=1)
    depth = np.zeros(len(origins))
    for _ in range(80):
        depth += distance(origins + depth[:, None] * directions) / length
    missed = depth > 2 * np.linalg.norm(camera_centre(pose))
    return np.where(missed, np.inf, depth).astype(np.float32).reshape(camera.height, camera.width)


def ball_field(metres_per_unit: float | None = None, views: int = 12, n: int = 32) -> Field:
    """A field that is one opaque ball of RED, as far as its occupancy has the shape of a ball."""
    config = FieldConfig(levels=2, log2_table=8, hidden=8, colour_hidden=8, occupancy_resolution=n)
    learnt = {name: np.zeros(shape, np.float32) for name, shape in learnt_shapes(config).items()}
    learnt["table"][:], learnt["w1"][:] = 1, 1 / 8
    learnt["w2"][:, 0] = 6.5 / 8
    learnt["w2"][:, 1:4] = (np.array(RED) / 255 - 0.5) / 8
    at = (np.stack(np.meshgrid(*3 * [np.arange(n)], indexing="ij"), axis=-1) + 0.5) / n * 2 - 1
    occupied = np.linalg.norm(at, axis=-1) < BALL_RADIUS
    cameras = [
        TrainingCamera(f"{i}", 64, 64, 90.0, 90.0, 31.5, 31.5, (0.0,) * 5, tuple(pose.ravel().tolist()))
        for i, pose in enumerate(around(views))
    ]
    metadata = FieldMetadata(
        Space(False, (0.0, 0.0, 0.0), 1.0), config, (1.0, 1.0, 1.0), cameras, "blender", "0" * 64,
        unit="span", metres_per_unit=metres_per_unit, has_background=False,
    )  # fmt: skip
    return Field(metadata, net_of(config, learnt), occupied)


def edges_of(triangles: np.ndarray) -> np.ndarray:
    """Directed edges (3m, 2)."""
    return np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])


def is_closed(triangles: np.ndarray) -> bool:
    """Whether each edge is there once in each direction."""
    edges, counts = np.unique(edges_of(triangles), axis=0, return_counts=True)
    return bool((counts == 1).all()) and {*map(tuple, edges)} == {*map(tuple, edges[:, ::-1])}


def volume(points: np.ndarray, triangles: np.ndarray) -> float:
    a, b, c = points.astype(np.float64)[triangles].transpose(1, 0, 2)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def read_ply(path: Path) -> tuple[list[str], np.ndarray, list[tuple[int, ...]]]:
    """Header lines, vertices (n, 9) and faces, value by value as the header describes them."""
    header, body = path.read_bytes().split(b"end_header\n", 1)
    lines = header.decode("ascii").splitlines()
    counts = {line.split()[1]: int(line.split()[2]) for line in lines if line.startswith("element")}
    at, vertices, faces = 0, [], []
    for _ in range(counts["vertex"]):
        vertices.append(struct.unpack_from("<6f3B", body, at))
        at += 27
    for _ in range(counts.get("face", 0)):
        corners = body[at]
        faces.append(struct.unpack_from(f"<{corners}i", body, at + 1))
        at += 1 + 4 * corners
    assert at == len(body)
    return lines, np.array(vertices), faces


def read_glb(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The JSON part, and the arrays of the one primitive by the names of its attributes, and `indices`."""
    data = path.read_bytes()
    assert struct.unpack_from("<4sII", data) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    tree = json.loads(data[20 : 20 + size])
    binary_size, binary_kind = struct.unpack_from("<I4s", data, 20 + size)
    assert (kind, binary_kind, size % 4, binary_size % 4) == (b"JSON", b"BIN\0", 0, 0)
    binary = data[28 + size :]
    assert len(binary) == binary_size >= tree["buffers"][0]["byteLength"]
    primitive = tree["meshes"][0]["primitives"][0]
    named = primitive["attributes"] | {"indices": primitive["indices"]}
    return tree, {name: _accessed(tree, binary, index) for name, index in named.items()}


def _accessed(tree: dict[str, Any], binary: bytes, index: int) -> np.ndarray:
    accessor = tree["accessors"][index]
    view = tree["bufferViews"][accessor["bufferView"]]
    kind = {5126: "<f4", 5123: "<u2", 5125: "<u4"}[accessor["componentType"]]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
    count = accessor["count"] * width
    assert view["byteOffset"] % 4 == 0
    assert view["byteLength"] == count * np.dtype(kind).itemsize
    values = np.frombuffer(binary, kind, count, view["byteOffset"])
    return values if width == 1 else values.reshape(-1, width)
