"""Light, computed once: each group of objects gets a light map, and its materials become self-luminous.

Pictures are then free of noise, agree with each other from all sides, and take a second each. What the map cannot
hold, the sheen that moves with the eye, is a reflection of the two lamps computed in the material.
"""

from __future__ import annotations

import bpy
import cv2
import numpy as np
from mathutils import Vector

LIGHT_UV = "light"


def select(things: list[bpy.types.Object]) -> None:
    bpy.ops.object.select_all(action="DESELECT")
    for thing in things:
        thing.select_set(True)
    bpy.context.view_layer.objects.active = things[0]


def joined(things: list[bpy.types.Object], name: str) -> bpy.types.Object:
    """One mesh of all `things`, their modifiers applied."""
    select(things)
    bpy.ops.object.convert(target="MESH")
    for thing in things:
        thing.data.uv_layers[0].name = "picture"
    bpy.ops.object.join()
    whole = bpy.context.view_layer.objects.active
    whole.name = name
    bpy.ops.object.transform_apply(location=True, rotation=True, scale=True)
    return whole


def trimmed(thing: bpy.types.Object, low: tuple[float, ...], high: tuple[float, ...]) -> None:
    """Remove the faces outside a box: the outer sides of the walls, which nobody sees."""
    import bmesh

    shape = bmesh.new()
    shape.from_mesh(thing.data)
    outside = [
        f
        for f in shape.faces
        if any(c < a or c > b for c, a, b in zip(f.calc_center_median(), low, high, strict=True))
    ]
    bmesh.ops.delete(shape, geom=outside, context="FACES")
    shape.to_mesh(thing.data)
    shape.free()


def unwrap(thing: bpy.types.Object) -> None:
    layer = thing.data.uv_layers.new(name=LIGHT_UV)
    thing.data.uv_layers.active = layer
    select([thing])
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="SELECT")
    bpy.ops.uv.smart_project(angle_limit=np.radians(60), island_margin=0.0015, area_weight=0.0)
    bpy.ops.object.mode_set(mode="OBJECT")


def bake(thing: bpy.types.Object, size: int, samples: int) -> bpy.types.Image:
    """Direct and indirect light without the surface's own colour, linear, in a float image."""
    image = bpy.data.images.new(f"{thing.name} light", size, size, float_buffer=True)
    image.colorspace_settings.name = "Non-Color"
    for slot in thing.material_slots:
        nodes = slot.material.node_tree.nodes
        target = nodes.new("ShaderNodeTexImage")
        target.name, target.image = LIGHT_UV, image
        nodes.active = target
    scene = bpy.context.scene
    scene.cycles.samples = samples
    select([thing])
    bpy.ops.object.bake(
        type="DIFFUSE",
        pass_filter={"DIRECT", "INDIRECT"},
        margin=6,
        uv_layer=LIGHT_UV,
        target="IMAGE_TEXTURES",
        use_clear=True,
    )
    _smooth(image)
    return image


def _smooth(image: bpy.types.Image) -> None:
    width, height = image.size
    values = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(values)
    rgba = values.reshape(height, width, 4)
    light = np.ascontiguousarray(np.log(rgba[..., :3] + 0.02))
    light = cv2.bilateralFilter(cv2.medianBlur(light, 3), 9, 0.25, 2.5)
    rgba[..., :3] = np.maximum(np.exp(light) - 0.02, 0)
    image.pixels.foreach_set(rgba.ravel())
    image.pack()


class Shader:
    """A small helper to write node expressions."""

    def __init__(self, material: bpy.types.Material) -> None:
        self.nodes, self.links = material.node_tree.nodes, material.node_tree.links

    def plug(self, socket: bpy.types.NodeSocket, value: object) -> None:
        if isinstance(value, bpy.types.NodeSocket):
            self.links.new(value, socket)
        else:
            socket.default_value = value

    def math(self, operation: str, a: object, b: object = 0.0) -> bpy.types.NodeSocket:
        node = self.nodes.new("ShaderNodeMath")
        node.operation = operation
        self.plug(node.inputs[0], a)
        self.plug(node.inputs[1], b)
        return node.outputs[0]

    def vector(self, operation: str, a: object, b: object) -> bpy.types.NodeSocket:
        node = self.nodes.new("ShaderNodeVectorMath")
        node.operation = operation
        self.plug(node.inputs[0], a)
        if operation == "SCALE":
            self.plug(node.inputs["Scale"], b)
        else:
            self.plug(node.inputs[1], b)
        return node.outputs["Value" if operation == "DOT_PRODUCT" else "Vector"]


def luminous(material: bpy.types.Material, lamps: list[tuple[Vector, float]]) -> None:
    """Emit picture x light + sheen x light, the sheen a lobe about each lamp's mirror direction."""
    write = Shader(material)
    shader = write.nodes["Principled BSDF"]
    picture = shader.inputs["Base Color"].links[0].from_socket
    roughness = shader.inputs["Roughness"].default_value
    strength = shader.inputs["Specular IOR Level"].default_value
    where = write.nodes.new("ShaderNodeUVMap")
    where.uv_map = LIGHT_UV
    light = write.nodes[LIGHT_UV]
    write.links.new(where.outputs[0], light.inputs[0])
    reflection = write.nodes.new("ShaderNodeTexCoord").outputs["Reflection"]
    sharpness = 2.0 / roughness**4 * 0.6
    sheen: object = 0.006
    for direction, weight in lamps:
        lobe = write.math(
            "POWER", write.math("MAXIMUM", write.vector("DOT_PRODUCT", reflection, direction)), sharpness
        )
        sheen = write.math("ADD", write.math("MULTIPLY", lobe, 0.5 * weight * strength / roughness), sheen)
    colour = write.vector("ADD", picture, _grey(write, sheen))
    emission = write.nodes.new("ShaderNodeEmission")
    write.links.new(write.vector("MULTIPLY", colour, light.outputs["Color"]), emission.inputs["Color"])
    write.links.new(emission.outputs[0], write.nodes["Material Output"].inputs["Surface"])
    write.nodes.remove(shader)
    material.cycles.emission_sampling = "NONE"


def _grey(write: Shader, value: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    node = write.nodes.new("ShaderNodeCombineXYZ")
    for socket in node.inputs:
        write.plug(socket, value)
    return node.outputs[0]
