"""Images with guesses of their poses, drawn as the published evaluations draw them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stages.geometry import perturb, rotation_error_deg, translation_error


@dataclass(frozen=True)
class Protocol:
    """`images` held-out images a seed, each with `poses` guesses: see stages.geometry.perturb.

    Angles are in degrees, lengths in units of the dataset as its reader gives it; the camera is turned about the
    origin of the dataset's coordinates.
    """

    name: str
    angle_deg: tuple[float, float]
    max_translation: float
    images: int = 5
    poses: int = 5


PROTOCOLS = {
    protocol.name: protocol
    for protocol in (
        Protocol("nerf-synthetic", (10.0, 40.0), 0.2),
        Protocol("llff", (0.0, 40.0), 0.1),
    )
}
"""The paper's section V-B, after iNeRF (Yen-Chen et al., 2021)."""


@dataclass(frozen=True)
class Pair:
    """An image by its place in the dataset, its true pose, and the guess; both (4, 4) cam_from_object."""

    seed: int
    image: int
    truth: np.ndarray
    guess: np.ndarray

    @property
    def guess_error(self) -> tuple[float, float]:
        """Rotation in degrees and translation of the guess."""
        return rotation_error_deg(self.guess, self.truth), translation_error(self.guess, self.truth)


def draw(protocol: Protocol, truths: Sequence[np.ndarray], seeds: Sequence[int]) -> list[Pair]:
    """The pairs of each seed, which are the same for every method; fewer images than wanted are all taken."""
    pairs = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        for image in rng.permutation(len(truths))[: protocol.images]:
            truth = truths[image]
            pairs += [
                Pair(seed, int(image), truth, perturb(truth, rng, protocol.angle_deg, protocol.max_translation))
                for _ in range(protocol.poses)
            ]
    return pairs
