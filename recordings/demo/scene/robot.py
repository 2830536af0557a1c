"""The main object: a tin robot, different on every side, about 1.4 units tall."""

from __future__ import annotations

import bpy
import numpy as np

from . import painting as p
from . import robot_prints as prints
from .painting import worn
from .primitives import ball, box, cylinder, lathe, paint, ring, tube, turned
from .surfaces import speckle, stripes

Part = bpy.types.Object


def enamel(colour: str, rng: np.random.Generator, amount: float = 0.12) -> bpy.types.Material:
    flat = np.broadcast_to(p.hex_rgb(colour), (192, 192, 3))
    return paint(worn(flat, rng, amount, 40), roughness=0.38)


def _body(rng: np.random.Generator) -> list[Part]:
    trunk = {
        "front": paint(prints.body_front(rng), 0.4),
        "back": paint(prints.body_back(rng), 0.4),
        "left": paint(prints.body_left(rng), 0.4),
        "right": paint(prints.body_right(rng), 0.4),
        "top": paint(prints.plate(rng, p.RED, p.MUSTARD, "FRAGILE"), 0.4),
        "bottom": enamel(p.NAVY, rng),
    }
    gauge = turned(
        cylinder("gauge", 0.085, 0.05, (0.26, -0.285, 0.50), enamel(p.NAVY, rng), paint(prints.meter(rng), 0.4)),
        x_deg=90,
    )
    knobs = [
        turned(cylinder("knob", 0.03, 0.07, (-0.30 + 0.08 * i, -0.29, 0.415), enamel(c, rng)), x_deg=90)
        for i, c in enumerate((p.MUSTARD, p.TEAL, p.CREAM))
    ]
    belt = box(
        "belt",
        (0.88, 0.56, 0.06),
        (0, 0, 0.345),
        {"all": paint(stripes(600, 60, (p.NAVY, p.MUSTARD), 30, rng, 0.6), 0.45)},
        0.015,
    )
    return [box("trunk", (0.84, 0.52, 0.56), (0, 0, 0.64), trunk, 0.05), gauge, belt, *knobs]


def _head(rng: np.random.Generator) -> list[Part]:
    skull = {
        "front": paint(prints.head_front(rng), 0.4),
        "back": paint(prints.head_side(rng, "REAR", p.CORAL), 0.4),
        "left": paint(prints.head_side(rng, "PORT", p.TEAL), 0.4),
        "right": paint(prints.head_side(rng, "STARBOARD", p.RED), 0.4),
        "top": paint(prints.plate(rng, p.MUSTARD, p.NAVY, "THIS UP"), 0.4),
        "bottom": enamel(p.MUSTARD, rng),
    }
    parts = [box("skull", (0.56, 0.44, 0.36), (0, 0, 1.17), skull, 0.06)]
    parts.append(
        cylinder("neck", 0.16, 0.09, (0, 0, 0.955), paint(stripes(400, 60, (p.INK, p.CREAM), 22, rng), 0.45))
    )
    for x, iris, radius in ((-0.125, p.SKY, 0.088), (0.125, p.LEAF, 0.075)):
        rim, disc = enamel(p.CREAM, rng), paint(prints.eye(rng, iris), 0.35)
        parts.append(turned(cylinder("eye", radius, 0.06, (x, -0.235, 1.225), rim, disc), x_deg=90))
        parts.append(turned(ring("eyelid", radius, 0.014, (x, -0.262, 1.225), enamel(p.RED, rng)), x_deg=90))
    parts += _aerials(rng)
    return parts


def _aerials(rng: np.random.Generator) -> list[Part]:
    banded = paint(stripes(60, 300, (p.CREAM, p.NAVY), 1, rng), 0.4)
    mast = turned(cylinder("mast", 0.018, 0.26, (-0.17, 0.02, 1.46), banded), y_deg=-12)
    bulb = ball(
        "bulb", 0.06, (-0.197, 0.02, 1.60), paint(speckle(300, 150, p.RED, (p.MUSTARD, p.CREAM), 60, rng), 0.35)
    )
    dish = lathe(
        "dish",
        [(0.015, 0), (0.07, 0.02), (0.12, 0.06), (0.15, 0.115), (0.14, 0.118), (0.07, 0.045), (0.001, 0.03)],
        (0.16, 0.02, 1.44),
        [paint(stripes(600, 80, (p.TEAL, p.CREAM, p.MUSTARD), 18, rng), 0.45)],
    )
    pin = cylinder("pin", 0.02, 0.1, (0.16, 0.02, 1.39), enamel(p.INK, rng))
    ears = [
        turned(
            cylinder(
                "ear",
                0.09,
                0.09,
                (x, 0, 1.18),
                enamel(p.NAVY, rng),
                paint(stripes(120, 120, (p.RED, p.CREAM), 6, rng, 0.4), 0.4),
                0.06,
            ),
            y_deg=90 * np.sign(x),
        )
        for x in (-0.315, 0.315)
    ]
    return [mast, bulb, turned(dish, x_deg=38, z_deg=25), pin, *ears]


def _arms(rng: np.random.Generator) -> list[Part]:
    bands = paint(stripes(80, 300, (p.TEAL, p.CREAM, p.TEAL, p.MUSTARD), 1, rng), 0.4)
    sleeve = paint(speckle(300, 200, p.TEAL, (p.CREAM, p.MINT, p.NAVY), 70, rng), 0.4)
    shoulders = [
        ball(
            "shoulder", 0.12, (x, -0.02, 0.80), paint(speckle(300, 150, p.NAVY, (p.MUSTARD, p.CREAM), 60, rng), 0.4)
        )
        for x in (-0.48, 0.48)
    ]
    lowered = turned(
        cylinder("arm", 0.075, 0.34, (-0.535, -0.06, 0.62), sleeve, top_radius=0.085), x_deg=-16, y_deg=10
    )
    cuff = turned(
        cylinder("cuff", 0.095, 0.07, (-0.566, -0.115, 0.44), enamel(p.MUSTARD, rng)), x_deg=-16, y_deg=10
    )
    claw = [
        tube(
            "claw",
            [
                (-0.57, -0.12, 0.42),
                (-0.57 + s * 0.12, -0.13, 0.37),
                (-0.57 + s * 0.11, -0.155, 0.28),
                (-0.57 + s * 0.02, -0.165, 0.25),
            ],
            0.024,
            bands,
        )
        for s in (-1, 1)
    ]
    raised = turned(
        cylinder("forearm", 0.085, 0.36, (0.60, -0.06, 0.90), sleeve, top_radius=0.07), x_deg=12, y_deg=38
    )
    fist = box("fist", (0.15, 0.15, 0.14), (0.715, -0.095, 1.05), {"all": enamel(p.MUSTARD, rng)}, 0.03)
    pole = cylinder(
        "pole", 0.016, 0.62, (0.715, -0.095, 1.24), paint(stripes(40, 400, (p.RED, p.CREAM), 1, rng), 0.4)
    )
    banner = paint(prints.flag(rng), 0.6)
    return [*shoulders, lowered, cuff, *claw, raised, turned(fist, y_deg=20), pole, _flag(banner)]


def _flag(material: bpy.types.Material) -> Part:
    """Stiff tin, waved once; both of its sides show the picture."""
    from .primitives import mesh

    columns = 24
    xs = np.linspace(0, 0.40, columns + 1)
    ys = 0.035 * np.sin(xs / 0.40 * 2 * np.pi)
    vertices = [(x, y, z) for z in (0.0, 0.27) for x, y in zip(xs, ys, strict=True)]
    row = columns + 1
    faces = [[i, i + 1, row + i + 1, row + i] for i in range(columns)]
    uvs = [
        [(i / columns, 0), ((i + 1) / columns, 0), ((i + 1) / columns, 1), (i / columns, 1)] for i in range(columns)
    ]
    flag = mesh("flag", vertices, faces, uvs, [material], smooth=True)
    flag.location = (0.72, -0.095, 1.27)
    flag.modifiers.new("tin", "SOLIDIFY").thickness = 0.012
    return turned(flag, z_deg=28)


def _legs(rng: np.random.Generator) -> list[Part]:
    parts = []
    for x, y, tone in ((-0.21, -0.03, p.TEAL), (0.21, 0.03, p.NAVY)):
        knee = paint(stripes(300, 120, (p.CREAM, tone), 14, rng, 0.3), 0.45)
        parts.append(cylinder("leg", 0.12, 0.2, (x, y, 0.24), knee))
        side = paint(stripes(460, 160, (tone, p.MUSTARD, tone, p.CORAL), 12, rng, -0.5), 0.45)
        top = paint(speckle(300, 400, tone, (p.CREAM, p.MUSTARD, p.CORAL), 60, rng), 0.45)
        parts.append(box("foot", (0.33, 0.50, 0.15), (x, y - 0.03, 0.075), {"all": side, "top": top}, 0.04))
    return parts


def _key(rng: np.random.Generator) -> list[Part]:
    brass = paint(stripes(200, 100, ("#d9a441", "#a8752a"), 16, rng), 0.4)
    shaft = turned(cylinder("shaft", 0.03, 0.16, (0.12, 0.32, 0.66), brass), x_deg=90)
    wings = [
        turned(ring("wing", 0.085, 0.026, (0.12 + s * 0.10, 0.405, 0.66 + s * 0.03), brass), x_deg=90)
        for s in (-1, 1)
    ]
    return [shaft, *wings]


def build(rng: np.random.Generator) -> list[Part]:
    return _body(rng) + _head(rng) + _arms(rng) + _legs(rng) + _key(rng)
