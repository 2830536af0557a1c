"""What edits do to pixels. An effect gives an image, and the share of it that still shows the scene.

Images are (h, w, 3) uint8 RGB; `seconds` is the time since the effect began.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from fieldpose.deploy.evaluation.occlusion import Occlusion, occluded, painted

GAMMA = 2.2
"""Pixels hold light to the power of 1 / GAMMA, so that twice the light is not twice the value."""
_TEXTURE_PX = 512
_TEXTURE_CELLS = (8, 24, 72)
_EDGE_PX = 1.5
_THINGS = Occlusion(covered=(0.3, 0.4))


@dataclass(frozen=True)
class Occluder:
    """A painted thing that comes nearer until it covers a share of the image, stays, and leaves to one side.

    It moves and turns all the time. Lengths are in shares of the image's shorter side.
    """

    texture: np.ndarray
    outline: np.ndarray
    towards: float
    covered: float
    grow_s: float
    stay_s: float
    leave_s: float

    @classmethod
    def drawn(cls, rng: np.random.Generator, covered: float, grow_s: float, stay_s: float, leave_s: float) -> Occluder:
        """One with a texture, an outline and a direction of its own."""
        towards = rng.uniform(0, 2 * np.pi)
        return cls(_texture(rng), _outline(rng), towards, covered, grow_s, stay_s, leave_s)

    def __call__(self, seconds: float, image: np.ndarray) -> tuple[np.ndarray, float]:
        grown = np.clip(seconds / self.grow_s, 0, 1)
        shape = image.shape[:2]
        staying = min(seconds, self.grow_s + self.stay_s)
        # Its distances are sorted, so that exactly the wanted share of pixels is within its outline.
        size = max(float(np.quantile(self._distances(shape, staying, (0.0, 0.0))[0], self.covered * grown)), 1e-3)
        distances, in_thing = self._distances(shape, seconds, self._away(shape, seconds, size))
        alpha = np.clip((size - distances) * min(shape) / _EDGE_PX + 0.5, 0, 1)[..., None]
        in_texture = ((in_thing / size + 1) * (_TEXTURE_PX / 2)).astype(np.float32)
        columns, rows = np.moveaxis(in_texture, -1, 0)
        thing = cv2.remap(self.texture, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        return np.rint(thing * alpha + image * (1 - alpha)).astype(np.uint8), float(1 - alpha.mean())

    def _distances(
        self, shape: tuple[int, int], seconds: float, away: tuple[float, float]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Of each pixel: its distance from the middle of a thing of size 1, in outlines; and where it is in the thing.

        (h, w) and (h, w, 2).
        """
        height, width = shape
        drift = 0.12 * np.sin(np.array([1.3, 1.7]) * seconds + self.towards)
        middle = (np.array([width, height]) / 2) / min(shape) + drift + away
        x, y = np.meshgrid(np.arange(width) / min(shape) - middle[0], np.arange(height) / min(shape) - middle[1])
        cos, sin = np.cos(0.4 * seconds), np.sin(0.4 * seconds)
        in_thing = np.stack([cos * x + sin * y, cos * y - sin * x], axis=-1)
        angles = np.linspace(-np.pi, np.pi, len(self.outline))
        radius = np.interp(np.arctan2(in_thing[..., 1], in_thing[..., 0]), angles, self.outline)
        return np.hypot(x, y) / radius, in_thing

    def _away(self, shape: tuple[int, int], seconds: float, size: float) -> tuple[float, float]:
        """How far it has moved from its place in front, at the end so far that nothing of it is in the image."""
        left = np.clip((seconds - self.grow_s - self.stay_s) / self.leave_s, 0, 1)
        distance = left * (size * self.outline.max() + np.hypot(*shape) / 2 / min(shape) + 0.2)
        return distance * np.cos(self.towards), distance * np.sin(self.towards)


def _outline(rng: np.random.Generator) -> np.ndarray:
    """Radii of a rough outline, at angles from -pi to pi."""
    angles = np.linspace(-np.pi, np.pi, 181)
    waves = sum(rng.normal() / k * np.cos(k * angles + rng.uniform(0, 2 * np.pi)) for k in range(2, 8))
    return np.clip(1 + 0.12 * waves, 0.6, 1.4)


def _texture(rng: np.random.Generator) -> np.ndarray:
    """(n, n, 3) uint8: patches of a few colours with sharp edges, at several scales."""
    height = np.zeros((_TEXTURE_PX, _TEXTURE_PX))
    for octave, cells in enumerate(_TEXTURE_CELLS):
        coarse = rng.uniform(-1, 1, (cells, cells)) / 1.5**octave
        height += cv2.resize(coarse, (_TEXTURE_PX, _TEXTURE_PX), interpolation=cv2.INTER_CUBIC)
    colours = rng.integers(20, 236, (6, 3), dtype=np.uint8)
    levels = np.quantile(height, np.linspace(0, 1, len(colours) + 1)[1:-1])
    return colours[np.digitize(height, levels)]


@dataclass(frozen=True)
class Elsewhere:
    """Another place of the same look: colours and textures of the image without its content, with things in front.

    The phases of the image's spectrum are replaced by those of noise, as in Galerne, Gousseau and Morel, "Random phase
    textures", 2011. The camera moves along it.
    """

    seed: int
    towards: float

    def __call__(self, seconds: float, image: np.ndarray) -> tuple[np.ndarray, float]:
        rng = np.random.default_rng(self.seed)
        texture, margin = _without_content(image, rng), min(image.shape[:2]) // 4
        wall = cv2.copyMakeBorder(texture, margin, margin, margin, margin, cv2.BORDER_WRAP)
        place, _ = occluded(wall, rng, painted, _THINGS)
        moved = margin * np.sin(seconds) * np.array([np.sin(self.towards), np.cos(self.towards)])
        row, column = np.rint(margin + moved).astype(int)
        return place[row : row + image.shape[0], column : column + image.shape[1]], 0.0


def _without_content(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    turns = np.exp(1j * np.angle(np.fft.rfft2(rng.normal(size=image.shape[:2]))))
    turns[0, 0] = 1  # or the mean would change
    spectrum = np.fft.rfft2(image, axes=(0, 1)) * turns[..., None]
    texture = np.fft.irfft2(spectrum, s=image.shape[:2], axes=(0, 1))
    return np.clip(np.rint(texture), 0, 255).astype(np.uint8)


def black(seconds: float, image: np.ndarray) -> tuple[np.ndarray, float]:
    """Nothing at all."""
    return np.zeros_like(image), 0.0


def streaked(length_px: int, angle_deg: float, seconds: float, image: np.ndarray) -> tuple[np.ndarray, float]:
    """The mean of the image over a straight movement of so many pixels."""
    side = length_px | 1
    line = np.zeros((side, side), np.float32)
    line[side // 2, :length_px] = 1
    turn = cv2.getRotationMatrix2D((side // 2, side // 2), angle_deg, 1.0)
    kernel = cv2.warpAffine(line, turn, (side, side), flags=cv2.INTER_LINEAR)
    return cv2.filter2D(image, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE), 1.0


def stepped(gains: Sequence[float], step_s: float, seconds: float, image: np.ndarray) -> tuple[np.ndarray, float]:
    """So many times the light, one gain after the other, each for a step."""
    return _exposed(image, gains[min(int(seconds / step_s), len(gains) - 1)]), 1.0


def flickering(
    depth: float, light_hz: float, phase: float, seconds: float, image: np.ndarray
) -> tuple[np.ndarray, float]:
    """Light that goes up and down by a share of its mean, as a short exposure catches it."""
    return _exposed(image, 1 + depth * np.sin(2 * np.pi * light_hz * seconds + phase)), 1.0


def _exposed(image: np.ndarray, gain: float) -> np.ndarray:
    values = np.arange(256) * gain ** (1 / GAMMA)
    return cv2.LUT(image, np.clip(np.rint(values), 0, 255).astype(np.uint8))
