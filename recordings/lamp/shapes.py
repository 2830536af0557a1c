"""Rods, wires, springs and plates, put where they belong. Lengths are scene units; z is up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import bpy
import numpy as np
from mathutils import Matrix, Vector
from mathutils.geometry import convex_hull_2d
from scene.primitives import Vec, cylinder, lathe, mesh, tube

Part = bpy.types.Object
Material = bpy.types.Material


@dataclass(frozen=True)
class Plane:
    """An upright plane through `origin`: s runs along its azimuth, z up, t across it."""

    origin: tuple[float, float]
    azimuth_deg: float

    @property
    def along(self) -> np.ndarray:
        a = np.radians(self.azimuth_deg)
        return np.array((np.cos(a), np.sin(a), 0.0))

    @property
    def across(self) -> np.ndarray:
        return np.cross((0.0, 0.0, 1.0), self.along)

    def at(self, point: Vec, t: float = 0.0) -> np.ndarray:
        s, z = point
        return np.array((*self.origin, z)) + s * self.along + t * self.across


def frame(where: Vec, direction: Vec) -> Matrix:
    """The transform that takes the origin to `where` and z to `direction`."""
    return Matrix.Translation(Vector(where)) @ Vector(direction).to_track_quat("Z", "Y").to_matrix().to_4x4()


def put(thing: Part, where: Vec, direction: Vec) -> Part:
    thing.matrix_world = frame(where, direction)
    return thing


def rod(start: Vec, end: Vec, radius: float, material: Material, tip: float | None = None) -> Part:
    """A straight round bar, conical where `tip`, its radius at the end, differs."""
    a, b = np.array(start, float), np.array(end, float)
    whole = cylinder("rod", radius, float(np.linalg.norm(b - a)), (0, 0, 0), material, top_radius=tip)
    return put(whole, (a + b) / 2, b - a)


def knob(where: Vec, direction: Vec, radius: float, length: float, material: Material) -> Part:
    """A round knob with rounded edges that stands on `where`."""
    edge = min(0.35 * radius, 0.45 * length)
    turns = np.linspace(0, np.pi / 2, 6)
    top = [(radius - edge + edge * np.cos(a), length - edge + edge * np.sin(a)) for a in turns]
    profile = [(1e-5, 0), (0.9 * radius, 0), (radius, 0.1 * edge), *top, (1e-5, length)]
    return put(lathe("knob", profile, (0, 0, 0), [material], segments=32), where, direction)


def through(points: Sequence[Vec], steps: int = 8) -> np.ndarray:
    """A smooth curve through all points (Catmull-Rom), sampled."""
    p = np.array(points, float)
    p = np.concatenate([[2 * p[0] - p[1]], p, [2 * p[-1] - p[-2]]])
    t = np.arange(steps)[:, None] / steps
    pieces = [
        b + 0.5 * t * (c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a)))
        for a, b, c, d in zip(p[:-3], p[1:-2], p[2:-1], p[3:], strict=True)
    ]
    return np.concatenate([*pieces, p[-2:-1]])


def wire(points: Sequence[Vec], radius: float, material: Material, steps: int = 6) -> Part:
    """A round wire bent through all points."""
    thing = tube("wire", through(points, steps), radius, material)
    thing.data.resolution_u, thing.data.bevel_resolution = 2, 3
    return thing


def spring(start: Vec, end: Vec, radius: float, thickness: float, pitch: float, material: Material) -> Part:
    """A helical spring whose wire ends straight, in the axis, at both ends."""
    a, b = np.array(start, float), np.array(end, float)
    length = float(np.linalg.norm(b - a))
    forward = (b - a) / length
    side = np.cross(forward, (0.3, 0.2, 1.0))
    side /= np.linalg.norm(side)
    run = np.arange(0.0, length, pitch / 12)
    ends = np.minimum(run, length - run) / length
    reach = radius * np.clip((ends - 0.07) / 0.035, 0, 1)
    turn = 2 * np.pi * run / pitch
    coil = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * np.cross(forward, side)
    thing = tube("spring", a + run[:, None] * forward + reach[:, None] * coil, thickness, material)
    thing.data.resolution_u, thing.data.bevel_resolution = 1, 2
    return thing


def plate(plane: Plane, pivots: Sequence[Vec], margin: float, t: float, thickness: float, material: Material) -> Part:
    """A flat plate in the plane, at `t` across it, that reaches `margin` round each of its pivots."""
    turns = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    discs = [(s + margin * np.cos(a), z + margin * np.sin(a)) for s, z in pivots for a in turns]
    outline = np.array([discs[i] for i in convex_hull_2d(discs)])
    middle = outline.mean(axis=0)
    outline = outline[np.argsort(np.arctan2(*(outline - middle).T[::-1]))]
    n = len(outline)
    vertices = [plane.at(p, t + side * thickness / 2) for side in (1, -1) for p in outline]
    faces = [[k, (k + 1) % n, n + (k + 1) % n, n + k] for k in range(n)]
    faces += [list(range(n))[::-1], list(range(n, 2 * n))]
    thing = mesh("plate", vertices, faces, [[(0.0, 0.0)] * len(face) for face in faces], [material], smooth=True)
    thing.data.set_sharp_from_angle(angle=np.radians(40))
    return thing
