"""What lies around on the desk. Low at the front and sides, where cameras pass; taller at the back."""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Matrix

from . import painting as p
from . import prints
from .primitives import ball, bevelled, box, carried, cylinder, lathe, mesh, paint, ring, tube, turned
from .robot import enamel
from .surfaces import cloth, cutting_mat, planks, plant_leaf, speckle, stripes


def _flat_things(rng: np.random.Generator) -> None:
    mat = paint(cutting_mat(1100, 800, 9, rng), 0.6, 0.2)
    turned(box("mat", (2.75, 2.0, 0.03), (0.05, -0.1, 0.016), {"all": mat}, 0.01), z_deg=7)
    page = paint(prints.page_of_text(rng), 0.8, 0.1)
    turned(box("page", (0.75, 1.0, 0.012), (-1.85, -1.45, 0.008), {"all": page}), z_deg=-24)
    plan = paint(prints.blueprint(rng), 0.8, 0.1)
    turned(box("plan", (1.25, 0.9, 0.012), (1.85, -1.7, 0.008), {"all": plan}), z_deg=17)
    napkin = paint(cloth(512, 512, p.CREAM, (p.RED, p.TEAL, p.MUSTARD), rng), 0.9, 0.05)
    turned(box("napkin", (0.95, 0.95, 0.016), (2.2, 0.1, 0.01), {"all": napkin}), z_deg=31)
    cards = paint(prints.shapes_poster(rng), 0.8, 0.1)
    turned(box("card", (0.8, 0.8, 0.012), (-0.35, -2.1, 0.008), {"all": cards}), z_deg=12)


def book(
    title: str,
    tones: tuple[str, str, str],
    size: tuple[float, float, float],
    centre: tuple[float, float, float],
    turn_deg: float,
    rng: np.random.Generator,
) -> None:
    """Lying flat, its spine to the front."""
    cover = paint(np.rot90(prints.book_cover(title, *tones, rng)), 0.5)
    sides = {
        "all": paint(prints.book_pages(rng), 0.8),
        "top": cover,
        "bottom": cover,
        "front": paint(prints.book_spine(title, *tones, rng), 0.5),
    }
    turned(box("book", size, centre, sides, 0.012), z_deg=turn_deg)


def _books(rng: np.random.Generator) -> None:
    book("SLOW RIVERS", (p.TEAL, p.CREAM, p.MUSTARD), (1.15, 0.82, 0.17), (-1.55, 1.15, 0.085), 12, rng)
    book("CLOCKWORK", (p.PLUM, p.MUSTARD, p.CORAL), (1.05, 0.76, 0.15), (-1.52, 1.12, 0.245), 3, rng)
    book("BIRD ATLAS", (p.CREAM, p.NAVY, p.RED), (0.95, 0.7, 0.13), (-1.58, 1.10, 0.385), 19, rng)
    book("RADIO CLUB", (p.MUSTARD, p.INK, p.TEAL), (1.0, 0.72, 0.16), (-2.45, -0.15, 0.08), 74, rng)


def _mug(rng: np.random.Generator) -> None:
    glaze, print_ = enamel(p.CREAM, rng, 0.08), paint(prints.mug_print(rng), 0.35)
    profile = [
        (0.001, 0.0),
        (0.2, 0.0),
        (0.24, 0.03),
        (0.25, 0.3),
        (0.25, 0.52),
        (0.235, 0.54),
        (0.22, 0.52),
        (0.21, 0.4),
        (0.001, 0.4),
    ]
    coffee = paint(speckle(200, 200, "#4a2a17", ("#6b4023", "#8a5a35"), 40, rng), 0.4)
    mug = lathe("mug", profile, (0, 0, 0), [glaze, print_, glaze, coffee], [0, 0, 1, 1, 2, 2, 2, 3])
    handle = tube(
        "handle", [(0.22, 0, 0.44), (0.40, 0, 0.46), (0.43, 0, 0.26), (0.36, 0, 0.1), (0.21, 0, 0.12)], 0.038, glaze
    )
    carried([mug, handle], Matrix.Translation((1.5, 0.75, 0.0)) @ Matrix.Rotation(np.radians(-25), 4, "Z"))


def _pencils(rng: np.random.Generator) -> None:
    label = paint(prints.tin_label("PENS", p.TEAL, rng), 0.5)
    inside = enamel(p.INK, rng)
    profile = [(0.001, 0.0), (0.24, 0.0), (0.24, 0.62), (0.225, 0.62), (0.22, 0.05), (0.001, 0.05)]
    lathe("jar", profile, (-0.55, 1.45, 0.0), [inside, label, inside], [0, 1, 2, 2, 2])
    for i, tone in enumerate((p.RED, p.MUSTARD, p.SKY, p.LEAF, p.CORAL, p.PLUM, p.CREAM)):
        turn = 2 * np.pi * i / 7 + 0.3
        shaft = paint(stripes(60, 400, (tone, p.INK, tone, tone), 6, rng), 0.45)
        stick = cylinder("pencil", 0.028, 0.85, (0, 0, 0.475), shaft)
        wood = cylinder("tip", 0.028, 0.1, (0, 0, 0.95), enamel("#e6c48f", rng), top_radius=0.004)
        tilt = Matrix.Rotation(np.radians(8 + 6 * rng.uniform()), 4, (-np.sin(turn), np.cos(turn), 0))
        place = Matrix.Translation((-0.55 + 0.08 * np.cos(turn), 1.45 + 0.08 * np.sin(turn), 0.06))
        carried([stick, wood], place @ tilt)


def _blocks(rng: np.random.Generator) -> None:
    tones = (p.RED, p.TEAL, p.NAVY, "#c77c17", p.PLUM, p.LEAF)
    spots = [
        (-1.18, -0.55, 0.16, 20),
        (-1.30, -0.93, 0.16, -18),
        (-1.22, -0.72, 0.48, 48),
        (1.25, -0.85, 0.16, 33),
        (0.62, -1.15, 0.13, -12),
    ]
    for i, (x, y, z, turn) in enumerate(spots):
        side = 0.32 if z != 0.13 else 0.26
        letters = "FIELDPOSENVRKATZ"
        faces = {
            f: paint(prints.toy_block(letters[(3 * i + j) % 16], tones[(i + j) % 6], rng), 0.6)
            for j, f in enumerate(("front", "back", "left", "right", "top", "bottom"))
        }
        turned(box("block", (side,) * 3, (x, y, z), faces, 0.02), z_deg=turn)
    cube = {f: paint(prints.puzzle_face(rng), 0.4) for f in ("front", "back", "left", "right", "top", "bottom")}
    turned(box("puzzle", (0.36,) * 3, (1.62, -0.35, 0.18), cube, 0.02), z_deg=-28)


def _plant(rng: np.random.Generator) -> None:
    clay = paint(speckle(700, 300, "#bf6a43", ("#d98a5f", "#f0c9a0", "#8f4527"), 260, rng), 0.7)
    soil = paint(speckle(200, 200, "#3a2a20", ("#5d4431", "#211812", "#8c6d4f"), 200, rng), 0.9)
    profile = [
        (0.001, 0.0),
        (0.22, 0.0),
        (0.30, 0.42),
        (0.34, 0.42),
        (0.35, 0.53),
        (0.31, 0.53),
        (0.29, 0.47),
        (0.001, 0.47),
    ]
    centre = (2.15, 1.35, 0.0)
    lathe("pot", profile, centre, [clay, soil], [0] * 6 + [1])
    for i in range(15):
        turn, lift = i * 2.4, 1.25 - 0.05 * i
        _leaf(np.array((2.15, 1.35, 0.46)), turn, lift, rng.uniform(0.55, 0.85), paint(plant_leaf(rng), 0.5))


def _leaf(root: np.ndarray, turn: float, lift: float, length: float, material: bpy.types.Material) -> None:
    """A bent blade that starts at elevation `lift` and sags along its length."""
    steps = 10
    out, where, slope = np.array((np.cos(turn), np.sin(turn), 0)), np.array(root, float), lift
    across = np.array((-np.sin(turn), np.cos(turn), 0))
    vertices = []
    for i in range(steps + 1):
        half = 0.13 * np.sin(np.pi * min((i + 0.8) / (steps + 1), 1)) ** 0.8
        lifted = where + np.array((0, 0, 0.3 * half))
        vertices += [lifted - half * across, lifted + half * across]
        where = where + length / steps * (np.cos(slope) * out + np.array((0, 0, np.sin(slope))))
        slope -= 1.5 / steps
    faces = [[2 * i, 2 * i + 1, 2 * i + 3, 2 * i + 2] for i in range(steps)]
    uvs = [[(0, i / steps), (1, i / steps), (1, (i + 1) / steps), (0, (i + 1) / steps)] for i in range(steps)]
    leaf = mesh("leaf", vertices, faces, uvs, [material], smooth=True)
    leaf.modifiers.new("blade", "SOLIDIFY").thickness = 0.012


def _small_things(rng: np.random.Generator) -> None:
    braid = paint(stripes(64, 2400, (p.CORAL, p.CREAM), 3, rng, 0.002), 0.6)
    tube(
        "cable",
        [
            (3.2, -1.0, 0.05),
            (2.3, -0.85, 0.045),
            (1.9, -1.25, 0.045),
            (1.2, -1.45, 0.045),
            (1.0, -1.9, 0.045),
            (0.3, -1.6, 0.045),
            (-0.6, -1.65, 0.045),
            (-0.95, -1.25, 0.05),
            (-1.6, -0.6, 0.045),
            (-2.1, -0.9, 0.045),
        ],
        0.042,
        braid,
    )
    lathe(
        "tape",
        [(0.15, 0), (0.26, 0), (0.26, 0.16), (0.15, 0.16), (0.15, 0)],
        (1.05, 0.42, 0.03),
        [paint(stripes(600, 100, (p.SKY, p.CREAM, p.RED), 15, rng, 0.4), 0.5)],
        smooth=True,
    )
    for i, (x, y, tone) in enumerate(((0.35, 1.55, p.RED), (0.92, 1.6, p.LEAF))):
        label, lid = (
            paint(prints.tin_label(("PAINT", "OIL")[i], tone, rng), 0.4),
            paint(speckle(200, 200, "#b9b2a2", (tone, p.INK), 40, rng), 0.4),
        )
        cylinder("tin", 0.25, 0.5 + 0.2 * i, (x, y, 0.25 + 0.1 * i), label, lid)
        ring("rim", 0.245, 0.018, (x, y, 0.5 + 0.2 * i), enamel("#b9b2a2", rng))
    ball(
        "ball",
        0.3,
        (-2.35, 0.95, 0.3),
        paint(stripes(1000, 300, (p.RED, p.CREAM, p.SKY, p.MUSTARD), 12, rng, 0.3), 0.4),
    )
    box(
        "parcel",
        (0.62, 0.5, 0.42),
        (-2.55, 1.7, 0.21),
        {"all": paint(prints.tin_label("ROBOT", "#b98550", rng), 0.7)},
        0.01,
    )
    handle = paint(stripes(200, 60, (p.MUSTARD, p.INK), 8, rng), 0.45)
    driver = [
        cylinder("handle", 0.055, 0.34, (0, 0, 0), handle),
        cylinder("blade", 0.02, 0.42, (0, 0, 0.36), enamel("#9aa0a6", rng)),
    ]
    carried(
        driver,
        Matrix.Translation((0.35, -0.86, 0.09))
        @ Matrix.Rotation(np.radians(64), 4, "Z")
        @ Matrix.Rotation(np.pi / 2, 4, "X"),
    )
    ruler = paint(planks(700, 70, 1, ("#e0bb85",), rng), 0.5)
    turned(box("ruler", (1.3, 0.13, 0.02), (-0.9, -1.95, 0.02), {"all": ruler}), z_deg=-33)
    for x, y in ((0.95, -0.45), (1.08, -0.5), (0.88, -0.6), (-0.8, 0.65), (-0.95, 0.55)):
        gear = cylinder("nut", 0.055, 0.05, (x, y, 0.055), enamel("#c59a3d", rng))
        bevelled(gear, 0.01, 2)


def build(rng: np.random.Generator) -> None:
    _flat_things(rng)
    _books(rng)
    _mug(rng)
    _pencils(rng)
    _blocks(rng)
    _plant(rng)
    _small_things(rng)
