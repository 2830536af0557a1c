"""Images with things pasted in front, as in the paper's section V-D: objects of another dataset, or painted blobs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from fieldpose.errors import DatasetError
from fieldpose.stages.nerf.datasets import Dataset

DrawThing = Callable[[np.random.Generator], np.ndarray]
"""Gives something to paste, (h, w, 4) uint8 RGBA."""

_MOST_THINGS = 12
_BLOB_PX = 256


@dataclass(frozen=True)
class Occlusion:
    """How much is covered: things of a size drawn from `size` (shares of the image's shorter side) are pasted one by
    one until they cover a share of the image drawn from `covered`."""

    covered: tuple[float, float] = (0.2, 0.4)
    size: tuple[float, float] = (0.35, 0.7)


def occluded(
    image: np.ndarray, rng: np.random.Generator, draw_thing: DrawThing, occlusion: Occlusion | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The image (h, w, 3) uint8 with things pasted anywhere, turned and scaled at random; and where, (h, w) bool."""
    occlusion = occlusion or Occlusion()
    height, width = image.shape[:2]
    result, hidden = image.astype(np.float64), np.zeros((height, width), bool)
    wanted = rng.uniform(*occlusion.covered)
    for _ in range(_MOST_THINGS):
        thing = _placed(draw_thing(rng), rng, (width, height), rng.uniform(*occlusion.size))
        alpha = thing[..., 3:]
        result = thing[..., :3] + result * (1 - alpha)
        hidden |= alpha[..., 0] > 0.5
        if hidden.mean() >= wanted:
            break
    return np.rint(result).astype(np.uint8), hidden


def objects_of(dataset: Dataset) -> DrawThing:
    """Things cut out of a dataset's images. Raises DatasetError where they have no transparent background."""
    if not dataset.has_alpha:
        raise DatasetError(f"{dataset.root}: occluders are cut out by their transparency, but its images have none")

    def draw(rng: np.random.Generator) -> np.ndarray:
        image = dataset.load_image(int(rng.integers(len(dataset))))
        rows, columns = np.nonzero(image[..., 3] > 0)
        if len(rows) == 0:
            return painted(rng)
        return image[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]

    return draw


def painted(rng: np.random.Generator) -> np.ndarray:
    """A blob with a rough outline, painted in two colours by a noise of its own."""
    turn = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    waves = sum(rng.normal() / k * np.cos(k * turn + rng.uniform(0, 2 * np.pi)) for k in range(1, 6))
    radius = 0.42 * _BLOB_PX * np.clip(0.75 + 0.18 * waves, 0.35, 1.0)
    outline = _BLOB_PX / 2 + radius[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    alpha = np.zeros((_BLOB_PX, _BLOB_PX), np.uint8)
    cv2.fillPoly(alpha, [np.rint(outline).astype(np.int32)], 255, cv2.LINE_AA)
    coarse = rng.uniform(0, 1, (12, 12)).astype(np.float32)
    mix = cv2.resize(coarse, (_BLOB_PX, _BLOB_PX), interpolation=cv2.INTER_CUBIC)[..., None]
    first, second = rng.uniform(0, 255, (2, 3))
    colours = np.where(mix > 0.5, first, second) + rng.normal(0, 6, (_BLOB_PX, _BLOB_PX, 1))
    return np.dstack([np.clip(colours, 0, 255).astype(np.uint8), alpha])


def _placed(thing: np.ndarray, rng: np.random.Generator, image_size: tuple[int, int], share: float) -> np.ndarray:
    """The thing on an empty layer (h, w, 4) float32, its longer side `share` of the image's shorter one.

    Alpha is in 0..1, and colours are multiplied by it: else what lies behind transparent pixels bleeds into edges.
    """
    width, height = image_size
    thing = thing.astype(np.float32)
    thing[..., 3] /= 255
    thing[..., :3] *= thing[..., 3:]
    own_height, own_width = thing.shape[:2]
    scale = share * min(image_size) / max(own_height, own_width)
    if scale < 1:  # by area, or thin parts alias
        size = (max(round(own_width * scale), 1), max(round(own_height * scale), 1))
        thing, scale = cv2.resize(thing, size, interpolation=cv2.INTER_AREA), 1.0
        own_height, own_width = thing.shape[:2]
    matrix = cv2.getRotationMatrix2D((own_width / 2, own_height / 2), rng.uniform(0, 360), scale)
    matrix[:, 2] += rng.uniform(0, (width, height)) - (own_width / 2, own_height / 2)
    return cv2.warpAffine(thing, matrix, (width, height), flags=cv2.INTER_LINEAR)
