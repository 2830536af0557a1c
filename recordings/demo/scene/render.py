"""Cycles: pictures, and exact depth and masks (one sample at the pixel's centre)."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix, Vector
from PIL import Image

from . import cameras

JPEG_QUALITY = 86


def prepare() -> bpy.types.Scene:
    """Settings for the light maps: a few diffuse bounces, no sharp reflections."""
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.device = "CYCLES", "CPU"
    scene.cycles.use_adaptive_sampling = scene.cycles.use_denoising = False
    scene.cycles.max_bounces, scene.cycles.diffuse_bounces, scene.cycles.glossy_bounces = 3, 3, 0
    scene.cycles.caustics_reflective = scene.cycles.caustics_refractive = False
    return scene


def only_look(scene: bpy.types.Scene) -> None:
    """Settings for the pictures, once surfaces are luminous: camera rays and nothing else."""
    for thing in [t for t in scene.objects if t.type == "LIGHT"]:
        bpy.data.objects.remove(thing)
    scene.cycles.samples, scene.cycles.max_bounces, scene.cycles.filter_width = 20, 0, 1.6
    scene.render.use_persistent_data = True
    scene.view_settings.view_transform = "Standard"
    scene.view_settings.exposure = -0.25
    scene.render.image_settings.file_format = "PNG"


def light(scene: bpy.types.Scene) -> list[tuple[Vector, float]]:
    """A large warm lamp from the front left, a cool one from the right, and a soft sky over the open top.

    Returns the lamps' directions and relative strengths.
    """
    directions = []
    for where, size, watts, tint in (
        ((-2.3, -2.4, 3.4), 2.0, 230.0, (1.0, 0.90, 0.76)),
        ((2.7, -1.6, 3.2), 1.8, 75.0, (0.80, 0.90, 1.0)),
    ):
        lamp = bpy.data.lights.new("lamp", "AREA")
        lamp.size, lamp.energy, lamp.color = size, watts, tint
        thing = bpy.data.objects.new("lamp", lamp)
        thing.matrix_world = Matrix(cameras.looking(np.array(where), np.zeros(3)).tolist())
        scene.collection.objects.link(thing)
        directions.append((Vector(where).normalized(), watts / 230.0))
    world = bpy.data.worlds.new("sky")
    world.use_nodes = True
    sky = world.node_tree.nodes["Background"]
    sky.inputs["Color"].default_value, sky.inputs["Strength"].default_value = (0.93, 0.95, 1.0, 1.0), 0.5
    scene.world = world
    return directions


def camera(scene: bpy.types.Scene, width: int, height: int, angle_x: float) -> None:
    data = bpy.data.cameras.new("camera")
    data.sensor_fit, data.angle, data.clip_start = "HORIZONTAL", angle_x, 0.01
    thing = bpy.data.objects.new("camera", data)
    scene.collection.objects.link(thing)
    scene.camera = thing
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = width, height, 100


def picture(scene: bpy.types.Scene, world_from_cam: np.ndarray, path: Path, seed: int) -> None:
    """Render to `path`, a JPEG or a PNG by its suffix."""
    scene.camera.matrix_world = Matrix(world_from_cam.tolist())
    scene.cycles.seed = seed
    scene.render.filepath = str(path.with_suffix(".png"))
    bpy.ops.render.render(write_still=True)
    if path.suffix == ".jpg":
        pixels = Image.open(path.with_suffix(".png")).convert("RGB")
        pixels.save(path, quality=JPEG_QUALITY, optimize=True, progressive=True)
        path.with_suffix(".png").unlink()


def measure_only(scene: bpy.types.Scene, folder: Path) -> None:
    """From here on renders give depth and object index: one sample at the centre of each pixel, nothing blurred."""
    scene.cycles.samples, scene.cycles.use_adaptive_sampling, scene.cycles.use_denoising = 1, False, False
    scene.cycles.pixel_filter_type, scene.cycles.filter_width, scene.cycles.max_bounces = "BOX", 0.01, 0
    layer = scene.view_layers[0]
    layer.use_pass_z = layer.use_pass_object_index = True
    scene.use_nodes = True
    nodes, links = scene.node_tree.nodes, scene.node_tree.links
    nodes.clear()
    source, sink = nodes.new("CompositorNodeRLayers"), nodes.new("CompositorNodeOutputFile")
    sink.base_path = str(folder)
    sink.format.file_format, sink.format.color_depth, sink.format.color_mode = "OPEN_EXR", "32", "RGB"
    sink.file_slots.clear()
    for slot, output in (("depth", "Depth"), ("index", "IndexOB")):
        sink.file_slots.new(slot)
        links.new(source.outputs[output], sink.inputs[slot])


def depth_and_index(
    scene: bpy.types.Scene, world_from_cam: np.ndarray, folder: Path
) -> tuple[np.ndarray, np.ndarray]:
    """(h, w) float32 depth along the optical axis in scene units, and (h, w) object index."""
    scene.camera.matrix_world = Matrix(world_from_cam.tolist())
    bpy.ops.render.render()
    return tuple(_read_exr(next(folder.glob(f"{slot}*.exr"))) for slot in ("depth", "index"))


def _read_exr(path: Path) -> np.ndarray:
    image = bpy.data.images.load(str(path))
    image.colorspace_settings.name = "Non-Color"
    width, height = image.size
    values = np.empty(width * height * image.channels, np.float32)
    image.pixels.foreach_get(values)
    bpy.data.images.remove(image)
    path.unlink()
    return values.reshape(height, width, -1)[::-1, :, 0].copy()


def bounds(things: list[bpy.types.Object]) -> list[list[float]]:
    """Two corners of the box around the evaluated geometry."""
    graph = bpy.context.evaluated_depsgraph_get()
    points = []
    for thing in things:
        shape = thing.evaluated_get(graph)
        mesh = shape.to_mesh()
        points += [shape.matrix_world @ v.co for v in mesh.vertices]
        shape.to_mesh_clear()
    corners = np.array(points, float)
    return [corners.min(axis=0).round(4).tolist(), corners.max(axis=0).round(4).tolist()]
