"""Files of surfaces: PLY (Stanford's polygon format, binary) and GLB (glTF 2.0 in one file)."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from fieldpose.deploy.reporting.output import check_writable
from fieldpose.errors import OutputError
from fieldpose.stages.nerf.surface.mesh import SurfaceMesh, SurfacePoints

_NAMES = ("x", "y", "z", "nx", "ny", "nz", "red", "green", "blue")
_VERTEX = np.dtype([(name, "<f4" if i < 6 else "u1") for i, name in enumerate(_NAMES)])
_FACE = np.dtype([("count", "u1"), ("vertex_indices", "<i4", 3)])
_FLOAT, _UNSIGNED_SHORT, _UNSIGNED_INT = 5126, 5123, 5125
_VERTICES, _INDICES = 34962, 34963
_JSON, _BINARY = 0x4E4F534A, 0x004E4942
Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""Takes what has z upwards to glTF's axes, y upwards and z to the viewer."""


def check_surface(path: Path | None, suffixes: Sequence[str], what: str) -> None:
    """Raise OutputError where a surface could not be written later, for its place or its kind."""
    check_writable(path)
    if path is not None and path.suffix not in suffixes:
        raise OutputError(f"{path}: no name of {what}; end it in {' or '.join(suffixes)}")


def ply(surface: SurfacePoints, comments: Sequence[str] = ()) -> bytes:
    """Points with normals and colours, with triangles where it is a mesh, in the coordinates that they have."""
    vertices = np.empty(len(surface.points), _VERTEX)
    for columns, names in zip((surface.points, surface.normals, surface.colours), _by_three(_NAMES), strict=True):
        for column, name in zip(columns.T, names, strict=True):
            vertices[name] = column
    kinds = ["float"] * 6 + ["uchar"] * 3
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {' '.join(c.split())}" for c in comments)]
    lines += [f"element vertex {len(vertices)}", *(f"property {k} {n}" for k, n in zip(kinds, _NAMES, strict=True))]
    body = vertices.tobytes()
    if isinstance(surface, SurfaceMesh):
        faces = np.empty(len(surface.triangles), _FACE)
        faces["count"], faces["vertex_indices"] = 3, surface.triangles
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        body += faces.tobytes()
    header = "\n".join([*lines, "end_header\n"])
    return header.encode() + body


def glb(mesh: SurfaceMesh, scale: float, extras: Mapping[str, Any]) -> bytes:
    """A mesh as a scene whose one node scales it and turns z upwards to y upwards; its numbers stay the object's.

    Colours are the light that was seen, so that viewers are told to add none (KHR_materials_unlit). extras: put into
    the file's asset, besides gltf_from_object, the node's matrix by rows.
    """
    matrix = np.diag([scale, scale, scale, 1.0]) @ Y_UP
    opaque = np.full((len(mesh.points), 1), 65535, "<u2")
    colours = np.concatenate([_linear(mesh.colours), opaque], axis=1)
    arrays = [mesh.points.astype("<f4"), mesh.normals.astype("<f4"), colours, mesh.triangles.astype("<u4").ravel()]
    chunks = [array.tobytes() for array in arrays]
    starts = np.cumsum([0, *map(len, chunks)]).tolist()
    views = [
        {"buffer": 0, "byteOffset": start, "byteLength": len(chunk), "target": _INDICES if i == 3 else _VERTICES}
        for i, (start, chunk) in enumerate(zip(starts, chunks, strict=False))
    ]
    told = {**extras, "gltf_from_object": matrix.tolist()}
    tree = {
        "asset": {"version": "2.0", "generator": "fieldpose", "extras": told},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "surface", "mesh": 0, "matrix": matrix.T.ravel().tolist()}],
        "meshes": [{"primitives": [_PRIMITIVE]}],
        "materials": [_MATERIAL],
        "accessors": _accessors(mesh),
        "bufferViews": views,
        "buffers": [{"byteLength": starts[-1]}],
    }
    text, binary = _padded(msgspec.json.encode(tree), b" "), _padded(b"".join(chunks), b"\0")
    parts = struct.pack("<II", len(text), _JSON), text, struct.pack("<II", len(binary), _BINARY), binary
    return struct.pack("<4sII", b"glTF", 2, 12 + sum(map(len, parts))) + b"".join(parts)


_PRIMITIVE = {"attributes": {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2}, "indices": 3, "material": 0}
_MATERIAL = {
    "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
    "doubleSided": True,
    "extensions": {"KHR_materials_unlit": {}},
}


def _accessors(mesh: SurfaceMesh) -> list[dict[str, Any]]:
    count = len(mesh.points)
    low, high = mesh.points.min(axis=0).tolist(), mesh.points.max(axis=0).tolist()
    return [
        {"bufferView": 0, "componentType": _FLOAT, "count": count, "type": "VEC3", "min": low, "max": high},
        {"bufferView": 1, "componentType": _FLOAT, "count": count, "type": "VEC3"},
        {"bufferView": 2, "componentType": _UNSIGNED_SHORT, "normalized": True, "count": count, "type": "VEC4"},
        {"bufferView": 3, "componentType": _UNSIGNED_INT, "count": mesh.triangles.size, "type": "SCALAR"},
    ]


def _linear(colours: np.ndarray) -> np.ndarray:
    """sRGB (n, 3) uint8 as glTF has vertex colours: linear, here in 16 bits, lest dark ones be rounded away."""
    s = np.arange(256) / 255
    table = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
    linear: np.ndarray = np.rint(65535 * table).astype("<u2")[colours]
    return linear


def _padded(chunk: bytes, filler: bytes) -> bytes:
    return chunk + filler * (-len(chunk) % 4)


def _by_three(names: Sequence[str]) -> list[Sequence[str]]:
    return [names[i : i + 3] for i in range(0, len(names), 3)]
