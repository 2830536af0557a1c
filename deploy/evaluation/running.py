"""Methods at work: images that they are shown, and the answers that they give."""

from __future__ import annotations

import time
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby, product

import numpy as np
from rich.progress import track

from fieldpose.deploy.evaluation.methods import METHODS, Finder
from fieldpose.deploy.evaluation.occlusion import DrawThing, occluded
from fieldpose.deploy.evaluation.pairs import Pair
from fieldpose.deploy.evaluation.scores import Answer
from fieldpose.deploy.reporting.output import progress_console
from fieldpose.deploy.settings import Settings
from fieldpose.stages.geometry import Camera
from fieldpose.stages.nerf.datasets import Dataset
from fieldpose.stages.nerf.rendering_api import RayRenderer
from fieldpose.stages.nerf.training_views import TrainingViews


@dataclass(frozen=True)
class Examination:
    """A field, and the pairs of a dataset's images and guesses that methods are asked for.

    images: (h, w, 3) uint8 by (seed, place in the dataset).
    """

    renderer: RayRenderer
    views: TrainingViews
    dataset: Dataset
    images: Mapping[tuple[int, int], np.ndarray]
    pairs: Sequence[Pair]

    def answers(
        self, names: Sequence[str], settings: Settings, slow_pairs: int
    ) -> Generator[tuple[str, Answer], None, None]:  # fmt: skip
        """The methods' answers; a slow one gets only `slow_pairs` of the pairs, evenly spread (0: all).

        They take turns image by image, so that no method meets the machine in a faster hour than another.
        """
        finders = {name: METHODS[name].make(self.renderer, settings, self.views) for name in names}
        slow = {id(pair) for pair in _spread(self.pairs, slow_pairs)}
        for name, finder in finders.items():
            if not METHODS[name].slow:
                self._warm_up(finder)
        turns = [
            (name, pair)
            for _, pairs in groupby(self.pairs, key=lambda pair: (pair.seed, pair.image))
            for name, pair in product(finders, list(pairs))
            if id(pair) in slow or not METHODS[name].slow
        ]
        for name, pair in track(turns, description="evaluating", console=progress_console()):
            question = self._question(pair)
            began = time.perf_counter()
            found = finders[name].find(*question)
            seconds = time.perf_counter() - began
            pose, scale_known = found.cam_from_object, METHODS[name].scale_known
            yield name, Answer(pair, pose, found.covariance, seconds, scale_known, found.stage_ms)

    def _warm_up(self, finder: Finder) -> None:
        """Networks are slow the first time, and some methods prepare for a camera."""
        for pair in {self.dataset.images[pair.image].camera: pair for pair in self.pairs}.values():
            finder.find(*self._question(pair))

    def _question(self, pair: Pair) -> tuple[np.ndarray, Camera, np.ndarray]:
        return self.images[pair.seed, pair.image], self.dataset.images[pair.image].camera, pair.guess


def shown(
    dataset: Dataset, pairs: Sequence[Pair], thing: DrawThing | None
) -> tuple[dict[tuple[int, int], np.ndarray], float | None]:
    """Images by (seed, place in the dataset), and the mean share of them that is covered where things are pasted."""
    images = {(pair.seed, pair.image): dataset.load_rgb(pair.image) for pair in pairs}
    if thing is None:
        return images, None
    covered = {key: occluded(image, np.random.default_rng(key), thing) for key, image in images.items()}
    share = float(np.mean([hidden.mean() for _, hidden in covered.values()]))
    return {key: image for key, (image, _) in covered.items()}, share


def _spread(pairs: Sequence[Pair], count: int) -> Sequence[Pair]:
    if not 0 < count < len(pairs):
        return pairs
    return [pairs[i * len(pairs) // count] for i in range(count)]
