"""Drawing on images, and what weathers them: every texture of the scene comes out of these few tools."""

from __future__ import annotations

import numpy as np
from PIL import Image, ImageDraw, ImageFont

Colour = str | tuple[int, int, int]
SUPERSAMPLING = 2

CREAM, RED, MUSTARD, NAVY, MINT, TEAL = "#f3e4c3", "#d4412a", "#eeac2e", "#1d2f4f", "#8ecbb4", "#1f6f78"
INK, CORAL, SKY, PLUM, LEAF, WHITE = "#23211f", "#ef7c5a", "#6fb1d8", "#6b3557", "#4d8a3f", "#fbf6ea"
PALETTE = (CREAM, RED, MUSTARD, NAVY, MINT, TEAL, CORAL, SKY, PLUM, LEAF)


class Canvas:
    """A drawing of `width` x `height` logical pixels, drawn larger and reduced once at the end."""

    def __init__(self, width: int, height: int, background: Colour) -> None:
        self.size = (width, height)
        self.image = Image.new("RGB", (width * SUPERSAMPLING, height * SUPERSAMPLING), background)
        self.draw = ImageDraw.Draw(self.image)

    def _scaled(self, values: tuple[float, ...]) -> list[float]:
        return [v * SUPERSAMPLING for v in values]

    def rectangle(
        self,
        box: tuple[float, float, float, float],
        fill: Colour | None = None,
        outline: Colour | None = None,
        width: float = 0,
        radius: float = 0,
    ) -> None:
        pen = round(width * SUPERSAMPLING)
        self.draw.rounded_rectangle(self._scaled(box), radius * SUPERSAMPLING, fill, outline, max(pen, 1))

    def disc(
        self,
        centre: tuple[float, float],
        radius: float,
        fill: Colour | None = None,
        outline: Colour | None = None,
        width: float = 0,
    ) -> None:
        x, y = centre
        box = self._scaled((x - radius, y - radius, x + radius, y + radius))
        self.draw.ellipse(box, fill, outline, max(round(width * SUPERSAMPLING), 1))

    def polygon(self, points: list[tuple[float, float]], fill: Colour) -> None:
        self.draw.polygon([(x * SUPERSAMPLING, y * SUPERSAMPLING) for x, y in points], fill)

    def line(self, points: list[tuple[float, float]], fill: Colour, width: float) -> None:
        scaled = [(x * SUPERSAMPLING, y * SUPERSAMPLING) for x, y in points]
        self.draw.line(scaled, fill, max(round(width * SUPERSAMPLING), 1), joint="curve")

    def text(self, centre: tuple[float, float], words: str, size: float, fill: Colour, weight: float = 0) -> None:
        font = ImageFont.load_default(size * SUPERSAMPLING)
        where = (centre[0] * SUPERSAMPLING, centre[1] * SUPERSAMPLING)
        self.draw.text(where, words, fill, font, anchor="mm", stroke_width=round(weight * SUPERSAMPLING))

    def pixels(self) -> np.ndarray:
        """(h, w, 3) float32 in 0..1, sRGB."""
        return np.asarray(self.image.resize(self.size, Image.Resampling.BOX), dtype=np.float32) / 255.0


def smooth_noise(shape: tuple[int, int], cells: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Bicubic noise in about -1..1 with `cells` (rows, columns) knots over the image."""
    knots = rng.uniform(-1, 1, cells).astype(np.float32)
    return np.asarray(Image.fromarray(knots).resize((shape[1], shape[0]), Image.Resampling.BICUBIC))


def fractal_noise(shape: tuple[int, int], cells: int, octaves: int, rng: np.random.Generator) -> np.ndarray:
    total = np.zeros(shape, np.float32)
    for octave in range(octaves):
        knots = max(2, cells * 2**octave)
        total += smooth_noise(shape, (knots, knots), rng) * 0.55**octave
    return total


def shaded(pixels: np.ndarray, amount: np.ndarray) -> np.ndarray:
    return np.clip(pixels * (1.0 + amount[..., None]), 0, 1).astype(np.float32)


def worn(pixels: np.ndarray, rng: np.random.Generator, amount: float = 0.07, chips: int = 60) -> np.ndarray:
    """Uneven paint, and small chips and stains, so that no surface is without features."""
    h, w = pixels.shape[:2]
    stained = shaded(pixels, amount * fractal_noise((h, w), 5, 5, rng))
    marks = Image.new("L", (w, h), 0)
    draw = ImageDraw.Draw(marks)
    for _ in range(chips):
        x, y = rng.uniform(0, w), rng.uniform(0, h)
        rx, ry = rng.uniform(0.002, 0.009, 2) * w
        draw.ellipse((x - rx, y - ry, x + rx, y + ry), fill=int(rng.uniform(70, 190)))
    alpha = np.asarray(marks, np.float32)[..., None] / 255.0
    colour = np.where(smooth_noise((h, w), (12, 12), rng)[..., None] > 0, 0.82, 0.2).astype(np.float32)
    return stained * (1 - alpha) + colour * alpha


def hex_rgb(colour: str) -> np.ndarray:
    return np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)], np.float32) / 255.0
