"""Printed matter: posters, book covers, notes, toy blocks, mug and tin labels."""

from __future__ import annotations

import numpy as np

from . import painting as p
from .painting import Canvas, worn


def rocket_poster(rng: np.random.Generator) -> np.ndarray:
    c = Canvas(600, 840, p.NAVY)
    for _ in range(220):
        c.disc((rng.uniform(0, 600), rng.uniform(0, 840)), rng.uniform(0.8, 3.2), p.CREAM)
    c.disc((455, 190), 105, p.MUSTARD)
    for x, y, r in ((420, 160, 26), (490, 235, 18), (480, 140, 12), (415, 240, 11)):
        c.disc((x, y), r, "#c98a1d")
    c.polygon([(0, 690), (150, 620), (330, 700), (470, 640), (600, 700), (600, 840), (0, 840)], p.TEAL)
    c.polygon([(0, 760), (210, 700), (420, 770), (600, 730), (600, 840), (0, 840)], p.MINT)
    c.polygon([(150, 420), (70, 610), (190, 560)], p.RED)
    c.polygon([(330, 420), (410, 610), (290, 560)], p.RED)
    c.polygon([(240, 110), (320, 260), (335, 460), (300, 590), (180, 590), (145, 460), (160, 260)], p.CREAM)
    c.polygon([(240, 110), (294, 210), (186, 210)], p.RED)
    c.disc((240, 310), 48, p.NAVY, p.MUSTARD, 10)
    c.disc((226, 298), 14, p.SKY)
    for i in range(6):
        c.rectangle((170 + 24 * i, 440, 182 + 24 * i, 520), (p.TEAL, p.RED, p.MUSTARD)[i % 3])
    c.polygon([(190, 592), (240, 740), (290, 592)], p.MUSTARD)
    c.polygon([(212, 592), (240, 680), (268, 592)], p.RED)
    c.text((300, 56), "TO THE MOON", 62, p.CREAM, 2)
    c.text((300, 800), "AND HOME BY SUPPER", 34, p.NAVY, 1.5)
    return worn(c.pixels(), rng, 0.05, 30)


def shapes_poster(rng: np.random.Generator) -> np.ndarray:
    c = Canvas(640, 640, p.CREAM)
    tones = (p.RED, p.NAVY, p.MUSTARD, p.TEAL, p.CORAL, p.INK, p.MINT)
    for row in range(4):
        for column in range(4):
            x, y = 30 + 145 * column, 30 + 145 * row
            ground, figure = rng.choice(tones, 2, replace=False)
            c.rectangle((x, y, x + 140, y + 140), str(ground))
            kind = rng.integers(4)
            if kind == 0:
                c.disc((x + 70, y + 70), 62, str(figure))
                c.disc((x + 70, y + 70), 30, str(ground))
            elif kind == 1:
                c.polygon([(x, y), (x + 140, y), (x, y + 140)], str(figure))
                c.disc((x + 98, y + 98), 22, p.CREAM)
            elif kind == 2:
                for i in range(4):
                    c.rectangle((x, y + 35 * i, x + 140, y + 35 * i + 17), str(figure))
            else:
                c.polygon([(x + 70, y + 6), (x + 134, y + 70), (x + 70, y + 134), (x + 6, y + 70)], str(figure))
    return worn(c.pixels(), rng, 0.05, 30)


def star_chart(rng: np.random.Generator) -> np.ndarray:
    c = Canvas(900, 640, "#e9d7ae")
    c.rectangle((18, 18, 882, 622), None, p.NAVY, 5)
    for x, tint in ((250, "#23406b"), (650, "#5b2d4d")):
        c.disc((x, 320), 185, tint, p.MUSTARD, 6)
        for r in (60, 122):
            c.disc((x, 320), r, None, "#8ea4c4", 1.6)
        stars = rng.uniform((x - 130, 190), (x + 130, 450), (26, 2))
        for a, b in zip(stars[:-1:2], stars[1::2], strict=True):
            c.line([tuple(a), tuple(b)], "#d9c88d", 1.8)
        for star in stars:
            c.disc(tuple(star), rng.uniform(2.5, 7), p.CREAM)
    c.text((450, 70), "THE NORTHERN & SOUTHERN SKY", 38, p.NAVY, 1.4)
    c.text((250, 560), "winter", 32, p.NAVY, 1)
    c.text((650, 560), "summer", 32, p.PLUM, 1)
    return worn(c.pixels(), rng, 0.07, 60)


def blueprint(rng: np.random.Generator) -> np.ndarray:
    c = Canvas(640, 460, "#27588f")
    for i in range(0, 640, 20):
        c.line([(i, 0), (i, 460)], "#34689f", 1)
        c.line([(0, i), (640, i)], "#34689f", 1)
    pen = "#e6f0f7"
    for box in ((90, 150, 230, 290), (115, 60, 205, 140), (110, 300, 150, 400), (170, 300, 210, 400)):
        c.rectangle(box, None, pen, 3, 8)
    c.disc((140, 95), 14, None, pen, 3)
    c.disc((182, 95), 14, None, pen, 3)
    c.disc((160, 215), 42, None, pen, 3)
    c.line([(230, 175), (310, 100)], pen, 3)
    c.line([(40, 420), (290, 420)], pen, 2)
    c.text((160, 438), "84 mm", 20, pen, 0.5)
    for r in (20, 52, 84):
        c.disc((460, 150), r, None, pen, 2.5)
    for i in range(12):
        a = 2 * np.pi * i / 12
        outward = np.array((np.cos(a), np.sin(a)))
        c.line([tuple((460, 150) + r * outward) for r in (84, 104)], pen, 7)
    c.rectangle((350, 320, 610, 430), None, pen, 3)
    c.text((480, 348), "FP-07 WALKER", 30, pen, 1)
    for i in range(4):
        c.line([(370, 375 + 13 * i), (370 + rng.uniform(120, 220), 375 + 13 * i)], pen, 3)
    return worn(c.pixels(), rng, 0.05, 25)


def note(colour: str, rng: np.random.Generator) -> np.ndarray:
    c = Canvas(220, 220, colour)
    kind = rng.integers(3)
    if kind == 0:
        for i in range(6):
            c.line([(20, 40 + 28 * i), (20 + rng.uniform(90, 180), 40 + 28 * i)], p.INK, 6)
    elif kind == 1:
        points = [(20 + 18 * i, 110 + rng.uniform(-70, 70)) for i in range(11)]
        c.line(points, p.RED, 6)
        c.line([(20, 20), (20, 200), (205, 200)], p.INK, 5)
    else:
        c.disc((110, 100), 60, None, p.NAVY, 8)
        c.line([(50, 180), (170, 40)], p.NAVY, 8)
        c.text((110, 195), "x = ?", 34, p.INK, 1)
    c.disc((110, 14), 10, p.RED)
    return worn(c.pixels(), rng, 0.05, 6)


def book_cover(title: str, ground: str, figure: str, accent: str, rng: np.random.Generator) -> np.ndarray:
    c = Canvas(420, 600, ground)
    c.rectangle((22, 22, 398, 578), None, accent, 7)
    for _ in range(9):
        x, y, r = rng.uniform(80, 340), rng.uniform(220, 500), rng.uniform(16, 70)
        c.disc((x, y), r, None, str(rng.choice((figure, accent))), rng.uniform(4, 16))
    for _ in range(7):
        points = [tuple(rng.uniform((60, 210), (360, 520))) for _ in range(3)]
        c.polygon(points, str(rng.choice((figure, accent))))
    for i, word in enumerate(title.split()):
        c.text((210, 74 + 56 * i), word, 50, figure, 2)
    return worn(c.pixels(), rng, 0.08, 40)


def book_spine(title: str, ground: str, figure: str, accent: str, rng: np.random.Generator) -> np.ndarray:
    c = Canvas(600, 110, ground)
    for x in (24, 44, 548, 568):
        c.rectangle((x, 0, x + 9, 110), accent)
    c.text((290, 53), title, 52, figure, 2)
    for x in (84, 508):
        c.disc((x, 55), 20, accent)
        c.disc((x, 55), 9, ground)
    return worn(c.pixels(), rng, 0.1, 30)


def book_pages(rng: np.random.Generator) -> np.ndarray:
    lines = rng.uniform(0.72, 1.0, (64, 1)).astype(np.float32) * np.ones((1, 256), np.float32)
    return worn(lines[..., None] * np.array([0.93, 0.88, 0.74], np.float32), rng, 0.06, 12)


def toy_block(letter: str, colour: str, rng: np.random.Generator) -> np.ndarray:
    c = Canvas(200, 200, "#e3bf87")
    c.rectangle((14, 14, 186, 186), None, colour, 13, 16)
    c.text((100, 96), letter, 128, colour, 5)
    return worn(c.pixels(), rng, 0.12, 40)


def puzzle_face(rng: np.random.Generator) -> np.ndarray:
    c = Canvas(240, 240, "#1c1c1e")
    for i in range(9):
        x, y = 8 + 76 * (i % 3), 8 + 76 * (i // 3)
        tone = str(rng.choice(("#c93327", "#2c62b4", "#e9b62a", "#3b8f4a", "#f1efe6", "#e5742a")))
        c.rectangle((x, y, x + 70, y + 70), tone, radius=12)
    return worn(c.pixels(), rng, 0.06, 18)


def mug_print(rng: np.random.Generator) -> np.ndarray:
    c = Canvas(1000, 340, p.CREAM)
    for i in range(14):
        x = 72 * i
        c.polygon([(x, 340), (x + 36, 270), (x + 72, 340)], (p.TEAL, p.RED, p.MUSTARD)[i % 3])
        c.disc((x + 36, 30), 13, (p.NAVY, p.CORAL)[i % 2])
    c.text((330, 150), "GOOD", 80, p.NAVY, 3)
    c.text((330, 222), "MORNING", 56, p.RED, 2)
    for x, y, r in ((700, 150, 70), (850, 190, 46), (90, 160, 50), (590, 215, 26)):
        for i in range(12):
            a = 2 * np.pi * i / 12
            c.line([(x, y), (x + r * 1.35 * np.cos(a), y + r * 1.35 * np.sin(a))], p.MUSTARD, 6)
        c.disc((x, y), r * 0.8, p.CORAL)
        c.disc((x, y), r * 0.45, p.MUSTARD)
    return worn(c.pixels(), rng, 0.04, 30)


def tin_label(name: str, colour: str, rng: np.random.Generator) -> np.ndarray:
    c = Canvas(900, 300, colour)
    c.rectangle((0, 0, 900, 34), p.MUSTARD)
    c.rectangle((0, 266, 900, 300), p.NAVY)
    for x in (180, 630):
        c.rectangle((x - 140, 60, x + 140, 240), p.CREAM, p.INK, 5, 24)
        c.text((x, 120), name, 62, p.RED, 2.5)
        c.text((x, 190), "No 12 - 250 ml", 32, p.INK, 1)
    for i in range(5):
        c.disc((405, 60 + 44 * i), 15, p.PALETTE[i + 1])
        c.disc((855, 60 + 44 * i), 15, p.PALETTE[i + 4])
    return worn(c.pixels(), rng, 0.08, 70)


def bunting(colour: str, rng: np.random.Generator) -> np.ndarray:
    c = Canvas(128, 128, colour)
    for _ in range(9):
        c.disc(
            (rng.uniform(0, 128), rng.uniform(0, 128)), rng.uniform(5, 13), str(rng.choice((p.CREAM, p.MUSTARD)))
        )
    return worn(c.pixels(), rng, 0.06, 8)


def page_of_text(rng: np.random.Generator) -> np.ndarray:
    c = Canvas(420, 560, p.WHITE)
    c.text((210, 44), "FIELD NOTES", 44, p.INK, 1.5)
    for i in range(22):
        y, x = 90 + 20 * i, 40.0
        while i not in (7, 8, 9, 10, 11) and x < 350:
            step = rng.uniform(15, 60)
            c.line([(x, y), (x + step, y)], "#4b4744", 5)
            x += step + 11
    c.rectangle((60, 226, 360, 326), p.MINT, p.INK, 3)
    c.polygon([(70, 320), (150, 250), (210, 300), (270, 240), (350, 320)], p.TEAL)
    c.disc((310, 256), 16, p.RED)
    return worn(c.pixels(), rng, 0.04, 20)
