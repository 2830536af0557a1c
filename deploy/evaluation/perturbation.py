"""Guesses made from the truth, as the published evaluations draw them, sent as any other prior from outside."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from fieldpose.bus.messages import Message, Prior, Truth
from fieldpose.bus.node import Output, reply_header
from fieldpose.bus.topics import PRIOR, TRUTH, Topic
from fieldpose.stages.geometry import Similarity, perturb
from fieldpose.stages.tracking.beginning import Disturbance


class PerturbationNode:
    """A Handler that answers each frame's true pose with that pose, disturbed as in the paper's section V-B.

    A frame's disturbance depends on the seed and its frame_id alone; an object out of view has none.
    object_from_dataset: from the frame of true poses, whose lengths the disturbance is in, into that of guesses.
    """

    name = "perturbation"
    inputs: tuple[Topic[Any], ...] = (TRUTH,)
    outputs: tuple[Topic[Any], ...] = (PRIOR,)

    def __init__(
        self, disturbance: Disturbance | None, seed: int, object_from_dataset: Similarity | None = None
    ) -> None:
        self._disturbance, self._seed = disturbance or Disturbance(), seed
        self._object_from_dataset = object_from_dataset or Similarity.identity()

    def start(self) -> None:
        """Nothing to load."""

    def handle(self, topic: Topic[Any], message: Message) -> Iterator[Output]:
        truth = message.cam_from_object if isinstance(message, Truth) else None
        if truth is None:
            return
        rng = np.random.default_rng([self._seed, message.header.frame_id])
        guess = perturb(
            np.array(truth, np.float64), rng, self._disturbance.angle_deg, self._disturbance.max_translation
        )
        moved = self._object_from_dataset.of_poses(guess[None])[0]
        yield PRIOR, Prior(header=reply_header(message.header), cam_from_object=moved)

    def tick(self, now_ns: int) -> Iterator[Output]:
        yield from ()

    def stop(self) -> None:
        """Nothing is held."""
