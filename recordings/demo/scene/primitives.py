"""Meshes with explicit texture coordinates. Lengths are scene units (0.1 m); z is up."""

from __future__ import annotations

from collections.abc import Sequence

import bpy
import numpy as np
from mathutils import Matrix, Vector

Vec = Sequence[float]
FACES = ("front", "back", "left", "right", "top", "bottom")
# Of each face: its normal, and the directions in which u and v of its picture grow.
FACE_AXES = {
    "front": ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    "back": ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
    "left": ((-1, 0, 0), (0, -1, 0), (0, 0, 1)),
    "right": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "top": ((0, 0, 1), (1, 0, 0), (0, 1, 0)),
    "bottom": ((0, 0, -1), (1, 0, 0), (0, -1, 0)),
}


def paint(pixels: np.ndarray, roughness: float = 0.5, specular: float = 0.3) -> bpy.types.Material:
    """A material from an (h, w, 3) sRGB picture in 0..1."""
    h, w = pixels.shape[:2]
    image = bpy.data.images.new("picture", w, h)
    rgba = np.ones((h, w, 4), np.float32)
    rgba[..., :3] = pixels[::-1]
    image.pixels.foreach_set(rgba.ravel())
    image.pack()
    return _principled(roughness, specular, image=image)


def plain(colour: np.ndarray, roughness: float = 0.5, specular: float = 0.3) -> bpy.types.Material:
    return paint(np.broadcast_to(colour.astype(np.float32), (4, 4, 3)), roughness, specular)


def _principled(roughness: float, specular: float, image: bpy.types.Image) -> bpy.types.Material:
    material = bpy.data.materials.new("paint")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    shader = nodes["Principled BSDF"]
    shader.inputs["Roughness"].default_value = roughness
    shader.inputs["Specular IOR Level"].default_value = specular
    texture = nodes.new("ShaderNodeTexImage")
    texture.image = image
    links.new(texture.outputs["Color"], shader.inputs["Base Color"])
    return material


def mesh(
    name: str,
    vertices: list[Vec],
    faces: list[list[int]],
    uvs: list[list[tuple[float, float]]],
    materials: Sequence[bpy.types.Material],
    slots: list[int] | None = None,
    smooth: bool = False,
) -> bpy.types.Object:
    data = bpy.data.meshes.new(name)
    data.from_pydata([tuple(v) for v in vertices], [], faces)
    layer = data.uv_layers.new(name="picture")
    layer.data.foreach_set("uv", np.array([c for face in uvs for c in face], np.float32).ravel())
    for material in materials:
        data.materials.append(material)
    for i, polygon in enumerate(data.polygons):
        polygon.material_index = slots[i] if slots else 0
        polygon.use_smooth = smooth
    thing = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(thing)
    return thing


def bevelled(thing: bpy.types.Object, width: float, segments: int = 3) -> bpy.types.Object:
    modifier = thing.modifiers.new("bevel", "BEVEL")
    modifier.width, modifier.segments, modifier.limit_method = width, segments, "ANGLE"
    modifier.harden_normals = True
    for polygon in thing.data.polygons:
        polygon.use_smooth = True
    return thing


def box(
    name: str, size: Vec, centre: Vec, faces: dict[str, bpy.types.Material], bevel: float = 0.0, repeat: float = 1.0
) -> bpy.types.Object:
    """A box with a picture on each face; `faces["all"]` stands in for those not named."""
    half = np.array(size) / 2
    vertices, quads, uvs, slots, materials = [], [], [], [], []
    corner_of: dict[tuple[float, ...], int] = {}
    for slot, face in enumerate(FACES):
        normal, right, up = (np.array(a, float) for a in FACE_AXES[face])
        quad = []
        for u, v in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
            corner = tuple((normal + u * right + v * up) * half)
            if corner not in corner_of:
                corner_of[corner] = len(vertices)
                vertices.append(corner)
            quad.append(corner_of[corner])
        quads.append(quad)
        uvs.append([(0, 0), (repeat, 0), (repeat, repeat), (0, repeat)])
        materials.append(faces.get(face, faces["all"]) if "all" in faces else faces[face])
        slots.append(slot)
    thing = mesh(name, vertices, quads, uvs, materials, slots)
    thing.location = Vector(centre)
    return bevelled(thing, bevel) if bevel else thing


def lathe(
    name: str,
    profile: Sequence[tuple[float, float]],
    centre: Vec,
    materials: Sequence[bpy.types.Material],
    slots: Sequence[int] | None = None,
    segments: int = 48,
    smooth: bool = True,
) -> bpy.types.Object:
    """A solid of revolution about z: `profile` is (radius, z) from the bottom; u runs around, v along."""
    radii, heights = np.array(profile, float).T
    run = np.concatenate([[0], np.cumsum(np.hypot(np.diff(radii), np.diff(heights)))])
    spans = len(profile) - 1
    slots = list(slots) if slots is not None else [0] * spans
    turns = 2 * np.pi * (np.arange(segments + 1) / segments - 0.5)
    vertices = [(r * np.sin(t), -r * np.cos(t), z) for r, z in zip(radii, heights, strict=True) for t in turns[:-1]]
    faces, uvs, marks = [], [], []
    for i in range(spans):
        same = [j for j in range(spans) if slots[j] == slots[i]]
        low, high = run[same[0]], run[same[-1] + 1]
        v0, v1 = (run[i] - low) / (high - low), (run[i + 1] - low) / (high - low)
        for k in range(segments):
            n = (k + 1) % segments
            faces.append([i * segments + k, i * segments + n, (i + 1) * segments + n, (i + 1) * segments + k])
            u0, u1 = k / segments, (k + 1) / segments
            uvs.append([(u0, v0), (u1, v0), (u1, v1), (u0, v1)])
            marks.append(slots[i])
    thing = mesh(name, vertices, faces, uvs, materials, marks, smooth)
    thing.location = Vector(centre)
    if smooth:
        thing.data.set_sharp_from_angle(angle=np.radians(40))
    return thing


def cylinder(
    name: str,
    radius: float,
    height: float,
    centre: Vec,
    side: bpy.types.Material,
    cap: bpy.types.Material | None = None,
    top_radius: float | None = None,
) -> bpy.types.Object:
    """Upright, `centre` at its middle; the caps carry a picture seen from above."""
    top = radius if top_radius is None else top_radius
    segments = 40
    turns = 2 * np.pi * (np.arange(segments) / segments - 0.5)
    ring = np.stack([np.sin(turns), -np.cos(turns)], 1)
    vertices = [(x * r, y * r, z) for r, z in ((radius, -height / 2), (top, height / 2)) for x, y in ring]
    faces = [[k, (k + 1) % segments, segments + (k + 1) % segments, segments + k] for k in range(segments)]
    uvs = [
        [(k / segments, 0), ((k + 1) / segments, 0), ((k + 1) / segments, 1), (k / segments, 1)]
        for k in range(segments)
    ]
    disc = [((x + 1) / 2, (y + 1) / 2) for x, y in ring]
    faces += [list(range(segments))[::-1], list(range(segments, 2 * segments))]
    uvs += [disc[::-1], disc]
    thing = mesh(name, vertices, faces, uvs, [side, cap or side], [0] * segments + [1, 1], smooth=True)
    thing.location = Vector(centre)
    thing.data.set_sharp_from_angle(angle=np.radians(40))
    return thing


def ball(name: str, radius: float, centre: Vec, material: bpy.types.Material) -> bpy.types.Object:
    latitudes = np.linspace(-np.pi / 2, np.pi / 2, 25)
    profile = [(max(radius * np.cos(a), 1e-5), radius * np.sin(a)) for a in latitudes]
    return lathe(name, profile, centre, [material], segments=48)


def ring(name: str, radius: float, thickness: float, centre: Vec, material: bpy.types.Material) -> bpy.types.Object:
    turns = np.linspace(0, 2 * np.pi, 17)
    profile = [(radius + thickness * np.cos(a), thickness * np.sin(a)) for a in turns]
    return lathe(name, profile, centre, [material])


def tube(name: str, points: Sequence[Vec], radius: float, material: bpy.types.Material) -> bpy.types.Object:
    """A round cable through `points`."""
    curve = bpy.data.curves.new(name, "CURVE")
    curve.dimensions, curve.bevel_depth, curve.bevel_resolution, curve.resolution_u = "3D", radius, 4, 16
    curve.use_fill_caps = True
    spline = curve.splines.new("NURBS")
    spline.points.add(len(points) - 1)
    for knot, point in zip(spline.points, points, strict=True):
        knot.co = (*point, 1.0)
    spline.use_endpoint_u, spline.order_u = True, 4
    curve.materials.append(material)
    thing = bpy.data.objects.new(name, curve)
    bpy.context.scene.collection.objects.link(thing)
    return thing


def turned(thing: bpy.types.Object, x_deg: float = 0, y_deg: float = 0, z_deg: float = 0) -> bpy.types.Object:
    thing.rotation_euler = np.radians([x_deg, y_deg, z_deg])
    return thing


def carried(things: Sequence[bpy.types.Object], move: Matrix) -> None:
    """Apply one world transform to several objects."""
    for thing in things:
        thing.matrix_world = move @ thing.matrix_basis
