"""The lithographed sheets of the tin robot: every side carries another drawing."""

from __future__ import annotations

import numpy as np

from . import painting as p
from .painting import Canvas, worn

BODY = p.RED


def rivets(c: Canvas, box: tuple[float, float, float, float], count: int, colour: str = "#f0c65a") -> None:
    x0, y0, x1, y1 = box
    for t in np.linspace(0, 1, count):
        for at in (
            (x0 + t * (x1 - x0), y0),
            (x0 + t * (x1 - x0), y1),
            (x0, y0 + t * (y1 - y0)),
            (x1, y0 + t * (y1 - y0)),
        ):
            c.disc(at, 6.5, "#5a1a12")
            c.disc(at, 4.5, colour)


def dial(c: Canvas, centre: tuple[float, float], radius: float, needle: float, face: str = p.WHITE) -> None:
    x, y = centre
    c.disc(centre, radius, face, p.INK, radius * 0.1)
    for a in np.linspace(-2.2, 2.2, 11):
        inner = 0.62 * radius
        c.line(
            [
                (x + inner * np.sin(a), y - inner * np.cos(a)),
                (x + 0.82 * radius * np.sin(a), y - 0.82 * radius * np.cos(a)),
            ],
            p.INK,
            radius * 0.06,
        )
    c.line([(x, y), (x + 0.72 * radius * np.sin(needle), y - 0.72 * radius * np.cos(needle))], p.RED, radius * 0.1)
    c.disc(centre, radius * 0.14, p.INK)


def body_front(rng: np.random.Generator) -> np.ndarray:
    c = Canvas(840, 560, BODY)
    rivets(c, (28, 28, 812, 532), 13)
    c.rectangle((70, 70, 770, 490), p.CREAM, p.NAVY, 9, 34)
    c.rectangle((96, 96, 420, 300), p.NAVY, p.MUSTARD, 6, 16)
    points = [(112 + 12 * i, 198 + 55 * np.sin(i * 0.62) * np.exp(-(((i - 13) / 9) ** 2))) for i in range(25)]
    for x in range(120, 420, 40):
        c.line([(x, 104), (x, 292)], "#355482", 2)
    c.line(points, "#7fe0a0", 6)
    dial(c, (540, 185), 84, 0.9)
    dial(c, (690, 150), 50, -1.1, p.MUSTARD)
    c.text((692, 232), "BAR", 26, p.NAVY, 1)
    for i in range(4):
        c.disc((640 + 36 * i, 272), 14, (p.RED, p.MUSTARD, p.LEAF, p.SKY)[i], p.INK, 3)
    for i in range(9):
        c.rectangle((104 + 24 * i, 326, 118 + 24 * i, 398), (p.TEAL, p.CORAL)[i % 2], radius=5)
    c.text((200, 442), "FP-07", 74, p.RED, 4)
    star = [
        (
            430 + (56 if i % 2 == 0 else 23) * np.sin(i * np.pi / 5),
            394 - (56 if i % 2 == 0 else 23) * np.cos(i * np.pi / 5),
        )
        for i in range(10)
    ]
    c.polygon(star, p.MUSTARD)
    c.rectangle((510, 316, 744, 462), p.TEAL, p.INK, 5, 12)
    for i in range(3):
        c.line([(526, 346 + 42 * i), (728, 346 + 42 * i)], p.INK, 6)
        c.rectangle((545 + (60 * i) % 130, 332 + 42 * i, 575 + (60 * i) % 130, 360 + 42 * i), p.CREAM, p.INK, 3, 5)
    return worn(c.pixels(), rng, 0.08, 110)


def body_left(rng: np.random.Generator) -> np.ndarray:
    c = Canvas(520, 560, BODY)
    rivets(c, (26, 26, 494, 534), 9)
    c.disc((260, 270), 168, p.CREAM, p.NAVY, 10)
    c.text((262, 262), "7", 250, p.NAVY, 11)
    for i in range(5):
        c.polygon([(40 + 96 * i, 534), (88 + 96 * i, 470), (136 + 96 * i, 534)], p.MUSTARD)
    c.text((260, 64), "LUNAR PATROL", 46, p.CREAM, 2)
    return worn(c.pixels(), rng, 0.08, 90)


def body_right(rng: np.random.Generator) -> np.ndarray:
    c = Canvas(520, 560, BODY)
    rivets(c, (26, 26, 494, 534), 9)
    c.rectangle((70, 80, 450, 300), "#b23320", p.INK, 6, 20)
    for i in range(7):
        c.rectangle((96, 102 + 27 * i, 424, 114 + 27 * i), p.INK, radius=6)
    c.polygon([(250, 320), (130, 440), (235, 440), (190, 530), (390, 395), (275, 395), (350, 320)], p.MUSTARD)
    c.text((400, 500), "9V", 60, p.CREAM, 3)
    c.text((105, 360), "!", 90, p.CREAM, 4)
    return worn(c.pixels(), rng, 0.08, 90)


def body_back(rng: np.random.Generator) -> np.ndarray:
    c = Canvas(840, 560, BODY)
    rivets(c, (28, 28, 812, 532), 13)
    c.rectangle((90, 90, 480, 470), p.TEAL, p.INK, 8, 26)
    for i in range(4):
        for j in range(4):
            c.disc((150 + 90 * i, 150 + 86 * j), 28, (p.NAVY, p.MINT, p.CREAM)[(i * 2 + j) % 3], p.INK, 4)
    c.text((650, 170), "MADE", 70, p.CREAM, 3)
    c.text((650, 245), "OF TIN", 70, p.CREAM, 3)
    c.text((650, 330), "serial 000731", 34, p.MUSTARD, 1)
    c.polygon([(540, 480), (650, 380), (760, 480)], p.MUSTARD)
    return worn(c.pixels(), rng, 0.08, 110)


def plate(rng: np.random.Generator, ground: str, accent: str, label: str) -> np.ndarray:
    """A lid or shoulder: bolts, a hatched border and two words."""
    c = Canvas(600, 400, ground)
    for i in range(-10, 40):
        c.polygon([(24 * i, 0), (24 * i + 12, 0), (24 * i - 22, 34), (24 * i - 34, 34)], accent)
        c.polygon([(24 * i, 366), (24 * i + 12, 366), (24 * i - 22, 400), (24 * i - 34, 400)], accent)
    rivets(c, (30, 60, 570, 340), 8, p.CREAM)
    c.disc((170, 200), 76, accent, p.INK, 6)
    c.text((400, 200), label, 60, accent, 3)
    return worn(c.pixels(), rng, 0.1, 80)


def head_front(rng: np.random.Generator) -> np.ndarray:
    c = Canvas(560, 360, p.MUSTARD)
    rivets(c, (24, 24, 536, 336), 9, p.CREAM)
    c.rectangle((60, 40, 500, 190), p.NAVY, p.INK, 7, 46)
    c.rectangle((110, 228, 450, 320), p.CREAM, p.INK, 7, 20)
    for i in range(8):
        c.rectangle((126 + 40 * i, 236, 148 + 40 * i, 312), (p.RED, p.TEAL)[i % 2])
    c.disc((62, 260), 26, p.CORAL)
    c.disc((498, 260), 26, p.CORAL)
    return worn(c.pixels(), rng, 0.07, 60)


def head_side(rng: np.random.Generator, label: str, accent: str) -> np.ndarray:
    c = Canvas(420, 360, p.MUSTARD)
    rivets(c, (24, 24, 396, 336), 7, p.CREAM)
    c.disc((210, 180), 120, accent, p.INK, 6)
    c.text((210, 62), label, 44, p.NAVY, 2)
    for i in range(10):
        c.rectangle((40 + 35 * i, 292, 58 + 35 * i, 322), (p.NAVY, p.RED)[i % 2])
    return worn(c.pixels(), rng, 0.07, 60)


def eye(rng: np.random.Generator, iris: str) -> np.ndarray:
    c = Canvas(200, 200, p.WHITE)
    c.disc((100, 100), 98, p.WHITE, p.INK, 10)
    c.disc((100, 104), 60, iris)
    for i in range(18):
        a = 2 * np.pi * i / 18
        c.line(
            [(100 + 30 * np.cos(a), 104 + 30 * np.sin(a)), (100 + 58 * np.cos(a), 104 + 58 * np.sin(a))], p.NAVY, 3
        )
    c.disc((100, 104), 31, p.INK)
    c.disc((82, 84), 13, p.WHITE)
    return worn(c.pixels(), rng, 0.03, 8)


def flag(rng: np.random.Generator) -> np.ndarray:
    c = Canvas(480, 320, p.CREAM)
    for i in range(12):
        for j in range(2):
            if (i + j) % 2:
                c.rectangle((40 * i, 20 * j, 40 * i + 40, 20 * j + 20), p.INK)
                c.rectangle((40 * i, 280 + 20 * j, 40 * i + 40, 300 + 20 * j), p.INK)
    c.disc((130, 160), 88, p.TEAL)
    c.disc((158, 142), 70, p.CREAM)
    c.text((330, 162), "07", 150, p.RED, 7)
    return worn(c.pixels(), rng, 0.07, 50)


def meter(rng: np.random.Generator) -> np.ndarray:
    c = Canvas(256, 256, p.MUSTARD)
    dial(c, (128, 128), 118, -0.6)
    c.text((128, 196), "JOY", 40, p.NAVY, 2)
    return worn(c.pixels(), rng, 0.04, 15)
