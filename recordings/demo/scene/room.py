"""The stage: a desk in a nook of three walls, open to the front and above, with posters and a shelf."""

from __future__ import annotations

import bpy
import numpy as np

from . import painting as p
from . import prints
from .primitives import box, mesh, paint, turned
from .robot import enamel
from .surfaces import cork, planks, wallpaper

BACK_Y, SIDE_X, FRONT_Y, TOP_Z = 2.2, 3.3, -3.3, 3.6
OAK, PINE = ("#b98550", "#a9743f", "#c4935c", "#9c6a3a"), ("#d8ae74", "#c99c62", "#e0bb85")


def frame(
    width: float, height: float, picture: bpy.types.Material, rng: np.random.Generator, tone: str
) -> list[bpy.types.Object]:
    """A picture in a frame, facing -y, its middle at the origin."""
    wood, t, d = enamel(tone, rng, 0.2), 0.07, 0.07
    sheet = box("picture", (width, 0.02, height), (0, -0.01, 0), {"all": picture})
    rails = [box("rail", (width + 2 * t, d, t), (0, -d / 2, s * (height + t) / 2), {"all": wood}) for s in (-1, 1)]
    posts = [box("post", (t, d, height), (s * (width + t) / 2, -d / 2, 0), {"all": wood}) for s in (-1, 1)]
    return [sheet, *rails, *posts]


def hang(things: list[bpy.types.Object], wall: str, along: float, z: float) -> None:
    """Put things made at the origin onto a wall; `along` is x on the back wall, y on the others."""
    from mathutils import Matrix

    from .primitives import carried

    place = {
        "back": Matrix.Translation((along, BACK_Y - 0.004, z)),
        "left": Matrix.Translation((-SIDE_X + 0.004, along, z)) @ Matrix.Rotation(np.pi / 2, 4, "Z"),
        "right": Matrix.Translation((SIDE_X - 0.004, along, z)) @ Matrix.Rotation(-np.pi / 2, 4, "Z"),
    }[wall]
    carried(things, place)


def _walls(rng: np.random.Generator) -> None:
    depth, width = BACK_Y - FRONT_Y, 2 * SIDE_X
    middle = (BACK_Y + FRONT_Y) / 2
    tones = {"back": "#2c7a7b", "left": "#c9573c", "right": "#d9a441"}
    sprigs = {
        "back": ("#1f5c62", "#57a79c", "#8fc9b3"),
        "left": ("#a83f2a", "#e08a63", "#f0b58b"),
        "right": ("#b97f24", "#efc873", "#f6dfa6"),
    }
    papers = {k: paint(wallpaper(1600, 900, tones[k], sprigs[k], rng), 0.7, 0.15) for k in tones}
    box("wall", (width, 0.1, TOP_Z), (0, BACK_Y + 0.05, TOP_Z / 2), {"all": papers["back"]})
    for name, x in (("left", -SIDE_X - 0.05), ("right", SIDE_X + 0.05)):
        box("wall", (0.1, depth, TOP_Z), (x, middle, TOP_Z / 2), {"all": papers[name]})
    desk = paint(planks(2048, 1708, 7, OAK, rng), 0.5, 0.25)
    box("desk", (width, depth, 0.12), (0, middle, -0.06), {"all": desk})
    skirting = paint(planks(1024, 40, 1, PINE, rng), 0.5)
    box("skirting", (width, 0.05, 0.16), (0, BACK_Y - 0.025, 0.08), {"all": skirting})
    for x in (-SIDE_X + 0.025, SIDE_X - 0.025):
        box("skirting", (0.05, depth, 0.16), (x, middle, 0.08), {"all": skirting})


def _pictures(rng: np.random.Generator) -> None:
    hang(frame(1.05, 1.47, paint(prints.rocket_poster(rng), 0.6), rng, "#e8d6ac"), "back", -1.62, 1.42)
    hang(frame(1.3, 0.93, paint(prints.star_chart(rng), 0.6), rng, "#3b2a20"), "back", 1.75, 0.95)
    hang(frame(1.25, 1.25, paint(prints.shapes_poster(rng), 0.6), rng, p.NAVY), "left", 0.75, 1.35)
    flea_market = prints.book_cover("SUNDAY FLEA MARKET", p.SKY, p.NAVY, p.RED, rng)
    hang(frame(0.86, 1.2, paint(flea_market, 0.6), rng, "#c8995a"), "left", -1.25, 1.15)
    jazz = prints.book_cover("MIDNIGHT BRASS BAND", p.PLUM, p.CREAM, p.MUSTARD, rng)
    hang(frame(0.8, 1.12, paint(jazz, 0.6), rng, p.TEAL), "right", -1.45, 1.25)


def _cork_board(rng: np.random.Generator) -> None:
    parts = frame(1.7, 1.25, paint(cork(680, 500, rng), 0.8, 0.1), rng, "#6d4526")
    places = [
        (-0.6, 0.35),
        (-0.18, 0.40),
        (0.30, 0.33),
        (0.64, 0.05),
        (-0.52, -0.28),
        (-0.05, -0.12),
        (0.36, -0.36),
    ]
    tones = ("#f5e27a", "#f2a0a0", "#a9d8a0", "#fbf6ea", "#9fc7ea", "#f7c77d", "#fbf6ea")
    for (x, z), tone in zip(places, tones, strict=True):
        sheet = box("note", (0.34, 0.012, 0.34), (x, -0.03, z), {"all": paint(prints.note(tone, rng), 0.8, 0.1)})
        parts.append(turned(sheet, y_deg=rng.uniform(-12, 12)))
    hang(parts, "right", 0.75, 1.25)


def _shelf(rng: np.random.Generator) -> None:
    wood = paint(planks(800, 60, 1, PINE, rng), 0.5)
    box("shelf", (2.3, 0.42, 0.07), (0.75, BACK_Y - 0.21, 1.98), {"all": wood}, 0.01)
    for x in (-0.25, 1.75):
        box("bracket", (0.06, 0.34, 0.2), (x, BACK_Y - 0.17, 1.85), {"all": wood}, 0.01)
    x, titles = -0.28, ("ORBITS", "TIN", "WAVES", "MAPS", "GEARS", "MOSS", "KITES", "SALT", "ECHO", "LAMPS", "RUST")
    for i, title in enumerate(titles):
        thick, tall = rng.uniform(0.10, 0.17), rng.uniform(0.5, 0.72)
        ground, figure, accent = rng.choice(p.PALETTE, 3, replace=False)
        spine = paint(np.rot90(prints.book_spine(title, str(ground), str(figure), str(accent), rng)), 0.55)
        lean = 9.0 if i == len(titles) - 1 else 0.0
        book = box(
            "book",
            (thick, 0.34, tall),
            (x + thick / 2 + lean * 0.008, BACK_Y - 0.2, 2.015 + tall / 2 + 0.003),
            {"all": paint(prints.book_pages(rng), 0.8), "front": spine, "left": spine, "right": spine},
            0.008,
        )
        turned(book, y_deg=-lean)
        x += thick + 0.006


def _bunting(rng: np.random.Generator) -> None:
    """Paper triangles on a string along the upper left of the back wall."""
    for i in range(7):
        t = (i + 0.5) / 7
        x, z = -3.0 + 2.5 * t, 2.75 - 0.9 * t * (1 - t)
        tone = (p.RED, p.MUSTARD, p.SKY, p.PLUM, p.CORAL, p.LEAF, p.NAVY)[i]
        corners = [(x - 0.15, BACK_Y - 0.03, z), (x, BACK_Y - 0.05, z - 0.32), (x + 0.15, BACK_Y - 0.03, z)]
        mesh("pennant", corners, [[0, 1, 2]], [[(0, 1), (0.5, 0), (1, 1)]], [paint(prints.bunting(tone, rng), 0.8)])


def build(rng: np.random.Generator) -> None:
    _walls(rng)
    _pictures(rng)
    _cork_board(rng)
    _shelf(rng)
    _bunting(rng)
