"""Textures without a subject: wood, wallpaper, cork, cutting mat, cloth, stripes, leaves, speckle."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from . import painting as p
from .painting import Canvas, fractal_noise, hex_rgb, shaded, smooth_noise, worn


def plank(height: int, width: int, colour: str, rng: np.random.Generator) -> np.ndarray:
    """One board, its grain along the rows."""
    warp = smooth_noise((height, width), (5, 7), rng) * 3.0
    rows = np.linspace(0, rng.uniform(5, 9), height, dtype=np.float32)[:, None]
    rings = np.sin((rows + warp) * 2 * np.pi) * 0.10
    fibres = smooth_noise((height, width), (max(height // 2, 4), 14), rng) * 0.09
    specks = smooth_noise((height, width), (height, max(width // 10, 4)), rng)
    base = np.broadcast_to(hex_rgb(colour) * rng.uniform(0.82, 1.12), (height, width, 3))
    return shaded(base, rings + fibres - 0.2 * (specks > 0.82))


def planks(width: int, height: int, count: int, colours: tuple[str, ...], rng: np.random.Generator) -> np.ndarray:
    edges = np.linspace(0, height, count + 1).astype(int)
    rows = []
    for top, bottom in pairwise(edges):
        cut = int(rng.uniform(0.25, 0.75) * width)
        parts = [plank(bottom - top, n, rng.choice(colours), rng) for n in (cut, width - cut)]
        parts[0][:, -3:] *= 0.35
        board = np.concatenate(parts, axis=1)
        board[:3] *= 0.4
        board[3:6] *= 1.12
        rows.append(board)
    return np.clip(np.concatenate(rows), 0, 1)


def leaf_outline(x: float, y: float, length: float, angle: float, width: float) -> list[tuple[float, float]]:
    along = np.linspace(0, 1, 14)
    across = np.sin(np.pi * along**0.8) * width
    points = np.concatenate([np.stack([along, across], 1), np.stack([along, -across], 1)[::-1]]) * length
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return [(float(a) + x, float(b) + y) for a, b in points @ turn]


def wallpaper(width: int, height: int, base: str, tones: tuple[str, ...], rng: np.random.Generator) -> np.ndarray:
    """Scattered sprigs that never repeat: a repeating pattern would match itself in the wrong place."""
    canvas = Canvas(width, height, base)
    for _ in range(width * height // 7000):
        x, y, angle = rng.uniform(0, width), rng.uniform(0, height), rng.uniform(0, 2 * np.pi)
        reach = rng.uniform(35, 85)
        tip = (x + reach * np.cos(angle), y + reach * np.sin(angle))
        tone = str(rng.choice(tones))
        canvas.line([(x, y), tip], tone, 2.5)
        for share in np.linspace(0.15, 1.0, int(rng.integers(3, 6))):
            at = (x + share * reach * np.cos(angle), y + share * reach * np.sin(angle))
            for side in (-1, 1):
                outline = leaf_outline(*at, reach * 0.42, angle + side * 0.8, 0.22)
                canvas.polygon(outline, tone)
        if rng.uniform() < 0.35:
            canvas.disc(tip, rng.uniform(5, 9), str(rng.choice((p.MUSTARD, p.CORAL, p.CREAM))))
    return worn(canvas.pixels(), rng, 0.06, 150)


def cork(width: int, height: int, rng: np.random.Generator) -> np.ndarray:
    grain = fractal_noise((height, width), 40, 4, rng)
    base = np.broadcast_to(hex_rgb("#c0894f"), (height, width, 3))
    return shaded(base, 0.22 * grain)


def cutting_mat(width: int, height: int, cells: int, rng: np.random.Generator) -> np.ndarray:
    canvas = Canvas(width, height, "#1c5a4c")
    step = (width - 80) / cells
    for i in range(cells * 5 + 1):
        x, y = 40 + i * step / 5, 40 + i * step / 5
        bold = i % 5 == 0
        colour, pen = ("#cfe3b8", 2.6) if bold else ("#3f8a70", 1.2)
        canvas.line([(x, 40), (x, height - 40)], colour, pen)
        if y <= height - 40:
            canvas.line([(40, y), (width - 40, y)], colour, pen)
        if bold:
            canvas.text((x, 22), str(i // 5), 22, "#e6efc8", 0.6)
            canvas.text((20, min(y, height - 30)), str(i // 5), 20, "#e6efc8", 0.6)
    for turn in (30, 45, 60):
        reach = (height - 80) * 0.95
        canvas.line(
            [
                (40, height - 40),
                (40 + reach * np.cos(np.radians(turn)), height - 40 - reach * np.sin(np.radians(turn))),
            ],
            "#e8d27a",
            2,
        )
    canvas.text((width * 0.76, height - 64), "SELF-HEALING  A3", 24, "#e6efc8", 0.8)
    for _ in range(60):
        x, y, turn, length = (
            rng.uniform(0, width),
            rng.uniform(0, height),
            rng.uniform(0, 3.1),
            rng.uniform(20, 170),
        )
        canvas.line([(x, y), (x + length * np.cos(turn), y + length * np.sin(turn))], "#154438", 1.5)
    for _ in range(45):
        tone = str(rng.choice(p.PALETTE))
        canvas.disc((rng.uniform(0, width), rng.uniform(0, height)), rng.uniform(2, 9), tone)
    return worn(canvas.pixels(), rng, 0.06, 90)


def stripes(
    width: int, height: int, colours: tuple[str, ...], count: int, rng: np.random.Generator, slope: float = 0.0
) -> np.ndarray:
    canvas = Canvas(width, height, colours[0])
    step = width / count
    for i in range(-count, 2 * count):
        lean = slope * height
        corners = [(i * step, 0), ((i + 1) * step, 0), ((i + 1) * step + lean, height), (i * step + lean, height)]
        canvas.polygon(corners, colours[i % len(colours)])
    return worn(canvas.pixels(), rng, 0.08, 40)


def speckle(
    width: int, height: int, base: str, tones: tuple[str, ...], count: int, rng: np.random.Generator
) -> np.ndarray:
    """Terrazzo: angular crumbs of several colours."""
    canvas = Canvas(width, height, base)
    for _ in range(count):
        x, y, size = rng.uniform(0, width), rng.uniform(0, height), rng.uniform(0.012, 0.04) * width
        turns = np.sort(rng.uniform(0, 2 * np.pi, 5))
        reach = size * rng.uniform(0.5, 1.0, 5)
        points = [(x + r * np.cos(t), y + r * np.sin(t)) for r, t in zip(reach, turns, strict=True)]
        canvas.polygon(points, str(rng.choice(tones)))
    return worn(canvas.pixels(), rng, 0.05, 20)


def plant_leaf(rng: np.random.Generator) -> np.ndarray:
    canvas = Canvas(128, 384, str(rng.choice(("#3f7d3a", "#55923f", "#2f6b3d"))))
    for y in range(10, 384, 22):
        for side in (-1, 1):
            canvas.line([(64, y), (64 + side * 64, y - rng.uniform(18, 46))], "#a9c96b", rng.uniform(2, 5))
    canvas.line([(64, 0), (64, 384)], "#d5dd8d", 5)
    canvas.rectangle((0, 0, 9, 384), "#dccf86")
    canvas.rectangle((119, 0, 128, 384), "#dccf86")
    return worn(canvas.pixels(), rng, 0.12, 25)


def cloth(width: int, height: int, base: str, tones: tuple[str, ...], rng: np.random.Generator) -> np.ndarray:
    """A woven check with uneven threads."""
    canvas = Canvas(width, height, base)
    for _ in range(16):
        x, pen = rng.uniform(0, width), rng.uniform(4, 26)
        canvas.line([(x, 0), (x, height)], str(rng.choice(tones)), pen)
    pixels = canvas.pixels()
    canvas = Canvas(width, height, base)
    for _ in range(14):
        y, pen = rng.uniform(0, height), rng.uniform(4, 26)
        canvas.line([(0, y), (width, y)], str(rng.choice(tones)), pen)
    weave = smooth_noise((height, width), (height // 2, width // 2), rng) * 0.12
    return shaded(0.5 * (pixels + canvas.pixels()), weave)
