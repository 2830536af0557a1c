"""Images with guesses of their poses, drawn as the published evaluations draw them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from fieldpose.stages.geometry import camera_centre, perturb, rotation_error_deg, translation_error

TurnAbout = Literal["origin", "camera"]


@dataclass(frozen=True)
class Protocol:
    """`images` held-out images a seed, each with `poses` guesses: see stages.geometry.perturb.

    Angles are in degrees, lengths in units of the dataset as its reader gives it. The camera is turned about the
    origin of the dataset's coordinates or about itself. occluded: things are pasted over the images. in_turn: guesses
    are turned or shifted, one after the other, and never both.
    """

    name: str
    angle_deg: tuple[float, float]
    max_translation: float
    images: int = 5
    poses: int = 5
    turn_about: TurnAbout = "origin"
    occluded: bool = False
    in_turn: bool = False


PROTOCOLS = {
    protocol.name: protocol
    for protocol in (
        Protocol("nerf-synthetic", (10.0, 40.0), 0.2),
        Protocol("llff", (0.0, 40.0), 0.1),
        Protocol("occluded", (0.0, 40.0), 0.1, occluded=True),
        Protocol("reach", (0.0, 180.0), 1.0, poses=10, in_turn=True),
    )
}
"""The first three: the paper's sections V-B to V-D, after iNeRF (Yen-Chen et al., 2021). reach: any turn, or a shift by
up to 1 (to be replaced by the object's diameter)."""


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
            pairs += [Pair(seed, int(image), truth, _guess(protocol, truth, rng, i)) for i in range(protocol.poses)]
    return pairs


def _guess(protocol: Protocol, truth: np.ndarray, rng: np.random.Generator, index: int) -> np.ndarray:
    angle_deg, shift = protocol.angle_deg, protocol.max_translation
    if protocol.in_turn:
        angle_deg, shift = ((0.0, 0.0), shift) if index % 2 else (angle_deg, 0.0)
    centre = camera_centre(truth) if protocol.turn_about == "camera" else np.zeros(3)
    return perturb(truth, rng, angle_deg, shift, centre)
