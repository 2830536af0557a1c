"""Adam over all parameters of a field, with the gradients of every thread."""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from fieldpose.stages.nerf.field import LEARNT
from fieldpose.stages.nerf.kernels.adam import adam_step
from fieldpose.stages.nerf.kernels.train import Gradients
from fieldpose.stages.nerf.kernels.types import Net
from fieldpose.stages.nerf.workers import Scratch, Workers

BETA1, BETA2, EPSILON = 0.9, 0.99, 1e-15
"""Instant-NGP's settings."""


class Optimiser:
    """Owns the moments and one set of gradients a thread."""

    def __init__(self, net: Net, threads: int):
        self.net = net
        shapes = {name: getattr(net, name).shape for name in LEARNT}
        self.gradients = [Gradients(**{n: np.zeros(s, np.float32) for n, s in shapes.items()}) for _ in range(threads)]
        self._moments = {
            n: (np.zeros(math.prod(s), np.float32), np.zeros(math.prod(s), np.float32)) for n, s in shapes.items()
        }
        self.steps = 0

    def compile(self) -> None:
        """Have the kernel compiled, without a step."""
        none = np.zeros(0, np.float32)
        gradients = tuple(none for _ in self.gradients)
        for sparse in (True, False):
            adam_step(none, gradients, none, none, 0, 0, 0.0, BETA1, BETA2, EPSILON, sparse)

    def step(self, rate: float, workers: Workers) -> None:
        """Update the parameters in place and clear the gradients."""
        self.steps += 1
        corrected = rate * math.sqrt(1 - BETA2**self.steps) / (1 - BETA1**self.steps)
        for name in LEARNT:
            parameter = getattr(self.net, name).reshape(-1)
            gradients = tuple(getattr(g, name).reshape(-1) for g in self.gradients)
            update = partial(
                self._update, parameter, gradients, *self._moments[name], rate=corrected, sparse=name == "table"
            )
            workers.each(len(parameter), 1 << 18, update)

    def _update(
        self,
        parameter: np.ndarray,
        gradients: tuple[np.ndarray, ...],
        mean: np.ndarray,
        square: np.ndarray,
        _: Scratch,
        first: int,
        last: int,
        rate: float,
        sparse: bool,
    ) -> None:
        adam_step(parameter, gradients, mean, square, first, last, rate, BETA1, BETA2, EPSILON, sparse)
