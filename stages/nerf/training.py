"""Learn a field from posed images with the compiled kernels."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stages.geometry.cameras import rays
from stages.nerf.config import FieldConfig, TrainingConfig
from stages.nerf.field import Field, domain_of, new_net
from stages.nerf.kernels.train import train
from stages.nerf.metadata import FieldMetadata, Space
from stages.nerf.occupancy import OccupancyEstimate, seen_by_cameras
from stages.nerf.optimiser import Optimiser
from stages.nerf.raybank import RayBank, View
from stages.nerf.renderer import NumbaRenderer
from stages.nerf.workers import Workers

PACKET = 32
ROWS = 16384
PER_RAY = 8
STOP_BELOW = 1e-3
CHUNK = 512
OCCUPANCY_EVERY = 16
SETTLED = 1024


@dataclass(frozen=True)
class Progress:
    """Where a training is: `fraction` of its time, the loss as a PSNR of the last batches, samples a second."""

    step: int
    fraction: float
    seconds: float
    train_psnr_db: float
    samples_per_s: float
    rays: int


class Trainer:
    """Holds the field that is being learnt; each step() improves it."""

    def __init__(self, views: list[View], space: Space, field: FieldConfig, config: TrainingConfig):
        self.config, self.space = config, space
        self._rng = np.random.default_rng(config.seed)
        self.net = new_net(field, self._rng)
        self.workers = Workers(field, config.threads, PACKET, ROWS, backward=True)
        self.optimiser = Optimiser(self.net, self.workers.threads)
        seen = seen_by_cameras(space, field.occupancy_resolution, [(v.camera, v.cam_from_object) for v in views])
        self._occupancy = OccupancyEstimate(space, field.occupancy_resolution, seen, self._rng)
        self._bank = RayBank(views, space)
        self._domain = domain_of(space, self._occupancy.occupied)
        self._rays = 512
        self.samples = 0

    @property
    def occupied(self) -> np.ndarray:
        """(n, n, n) bool, as a Field keeps it."""
        return self._occupancy.occupied

    def step(self, fraction: float) -> float:
        """One batch at a `fraction` 0..1 of the schedule; returns its mean squared error."""
        config = self.config
        every = OCCUPANCY_EVERY if self.optimiser.steps < SETTLED else 4 * OCCUPANCY_EVERY
        if self.optimiser.steps % every == 0:
            self.update_occupancy()
        rate = config.learning_rate * (config.final_learning_rate / config.learning_rate) ** fraction
        n = self._rays
        batch = self._bank.draw(self._rng, n)
        jitter = self._rng.random(n, dtype=np.float32)
        scale = np.float32(1 / n)
        done = self.workers.split(
            n,
            lambda s, a, b: train(
                self.net, self._domain, batch.origins, batch.directions, jitter, batch.background, batch.target,
                a, b,
                PER_RAY, STOP_BELOW, np.float32(config.huber_delta), np.float32(config.distortion), scale,
                s.samples, s.rays, self.optimiser.gradients[s.index],
            ),
        )  # fmt: skip
        self.optimiser.step(rate, self.workers)
        evaluated = sum(d[1] for d in done)  # type: ignore[index]
        self.samples += evaluated
        self._adapt(evaluated / n)
        return sum(d[0] for d in done) / (3 * n)  # type: ignore[index]

    def _adapt(self, samples_per_ray: float) -> None:
        wanted = self.config.samples_per_step / max(samples_per_ray, 1.0)
        self._rays = int(np.clip(wanted, 0.8 * self._rays, 1.25 * self._rays + 1))
        self._rays = int(np.clip(self._rays, 256, 1 << 15))

    def update_occupancy(self) -> None:
        """Look again at a part of the grid, at all of it the first time."""
        steps = self.optimiser.steps
        self._occupancy.update(self.net, self.workers, 1.0 if steps == 0 else (0.25 if steps < 256 else 1 / 8))
        self._domain = domain_of(self.space, self._occupancy.occupied)

    def run(self, report: Callable[[Progress], None]) -> tuple[int, float]:
        """Step until the time (or the number of steps) of the configuration is over; returns steps and seconds.

        KeyboardInterrupt passes through; the field is consistent after it.
        """
        config = self.config
        start = time.monotonic()
        error, step = 0.0, 0
        while True:
            seconds = time.monotonic() - start
            fraction = step / config.steps if config.steps else seconds / (60 * config.minutes)
            if fraction >= 1:
                return step, seconds
            mse = self.step(fraction)
            step += 1
            error = mse if step == 1 else 0.95 * error + 0.05 * mse
            report(Progress(step, fraction, seconds, psnr(error), self.samples / max(seconds, 1e-9), self._rays))

    def field(self, metadata: FieldMetadata) -> Field:
        """The field as learnt so far (not a copy)."""
        return Field(metadata, self.net, self.occupied)


def psnr(mean_squared_error: float) -> float:
    """Peak signal-to-noise ratio in dB of colours in 0..1."""
    return float(-10 * np.log10(max(mean_squared_error, 1e-12)))


def evaluate(renderer: NumbaRenderer, views: list[View], every: int = 1) -> list[float]:
    """PSNR of each view over every so-manieth pixel, its transparent parts over the field's background."""
    result = []
    background = np.array(renderer.metadata.background)
    for view in views:
        origins, directions = rays(view.camera, view.cam_from_object, view.camera.grid()[::every])
        rendered = renderer.render_rays(origins, directions).rgb
        truth = view.image.reshape(-1, view.image.shape[2])[::every] / 255.0
        if truth.shape[1] == 4:
            truth = truth[:, :3] * truth[:, 3:] + (1 - truth[:, 3:]) * background
        result.append(psnr(float(np.mean((rendered - truth) ** 2))))
    return result
