"""Learn a field from posed images with the compiled kernels."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from fieldpose.stages.geometry import camera_centre, nearest_point_to_axes
from fieldpose.stages.geometry.cameras import rays
from fieldpose.stages.nerf.blocks import View
from fieldpose.stages.nerf.config import FieldConfig, TrainingConfig
from fieldpose.stages.nerf.exploration import POSSIBLE, SURE, due, missing, silhouettes
from fieldpose.stages.nerf.field import Field, domain_of, new_net
from fieldpose.stages.nerf.hull import hull
from fieldpose.stages.nerf.kernels.density import densities
from fieldpose.stages.nerf.kernels.train import train
from fieldpose.stages.nerf.kernels.types import Net
from fieldpose.stages.nerf.metadata import FieldMetadata, Space
from fieldpose.stages.nerf.occupancy import OccupancyEstimate, near_cameras, seen_by_cameras
from fieldpose.stages.nerf.optimiser import Optimiser
from fieldpose.stages.nerf.raybank import Batch, RayBank
from fieldpose.stages.nerf.renderer import NumbaRenderer
from fieldpose.stages.nerf.workers import Workers

PACKET, PACKET_ROWS = 128, 768
ROWS = 16384
PER_RAY = 4
GROWTH = 2.0
"""By how many times its first size a batch grows until the end: many small steps find the scene, large ones its
details. In a minute that is worth 0.3 to 0.6 dB on fox and lego; large ones from the start cost fox what lego gains."""
STOP_BELOW = 1e-3
CHUNK = 512
OFTEN, SETTLED = 256, 1024
OCCUPANCY_EVERY = (16, 32, 64)
FREE_SHARE = 0.2
LATE, WITHIN, UNTIL = 0.5, 0.6, 0.5
"""Share of the rays that begin late, in the beginning; up to where, of the distance to what the cameras look at; and
when, of the training, the last one does. A papered room has 27 dB by it; without, haze wins: 15."""
DISTORTION = {False: 1e-2, True: 5e-2}
REWEIGH_EVERY = 32
STRIDE = {False: 1.5, True: 1.0}
"""Training steps are longer than rendering's, by whether space is contracted: their jitter makes up for it."""
FIRST_RAYS, RAYS = 512, (256, 1 << 15)


@dataclass(frozen=True)
class Progress:
    """Where a training is: `fraction` of its time, the loss as a PSNR of the last batches, samples a second."""

    step: int
    fraction: float
    seconds: float
    train_psnr_db: float
    samples_per_s: float
    rays: int


class Learner(ABC):
    """A field that is being learnt; each step() improves it. What a batch does is the subclass's."""

    def __init__(self, views: list[View], space: Space, field: FieldConfig, config: TrainingConfig):
        self.config = config
        self.space = msgspec.structs.replace(space, step=space.step * STRIDE[space.contracted])
        self.distortion = DISTORTION[space.contracted] if config.distortion is None else config.distortion
        self._rng = np.random.default_rng(config.seed)
        self._focus = _distance_of_focus(views) / space.scale
        n = field.occupancy_resolution
        seen = seen_by_cameras(space, n, [(v.camera, v.cam_from_object) for v in views])
        allowed = seen & ~_before_lenses(views, space, n)
        self._bank = RayBank(views, space)
        shown = silhouettes(views)
        if shown:
            allowed = hull(shown, space, allowed, POSSIBLE)
            self._bank.blocks.use(space, allowed)
        self._occupancy = OccupancyEstimate(self.space, n, allowed, self._rng)
        if shown:
            self._occupancy.hold(np.flatnonzero(hull(shown, space, allowed, SURE)))
        self._rays, self._wanted = FIRST_RAYS, float(config.samples_per_step)
        self.samples = self.steps = 0

    @abstractmethod
    def learn(self, batch: Batch, jitter: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray, int]:
        """Take one optimisation step; returns each ray's squared error and depth (0: none), and the samples."""

    @abstractmethod
    def densities(self, u: np.ndarray) -> np.ndarray:
        """Densities (n,) float32 at points (n, 3) of the unit cube."""

    @abstractmethod
    def occupancy_changed(self, occupied: np.ndarray) -> None:
        """Take over a new (n, n, n) bool occupancy."""

    @abstractmethod
    def net(self) -> Net:
        """The parameters as they are now."""

    def field(self, metadata: FieldMetadata) -> Field:
        """The field as learnt so far; it may share memory with the learner."""
        return Field(metadata, self.net(), self._occupancy.occupied)

    def step(self, fraction: float) -> float:
        """One batch at a `fraction` 0..1 of the schedule; returns its mean squared error."""
        if self.steps % OCCUPANCY_EVERY[(self.steps >= OFTEN) + (self.steps >= SETTLED)] == 0:
            self.look_again()
        if due(self.steps, fraction):
            self.look_for_missing()
        if self.steps % REWEIGH_EVERY == 0:
            self._bank.blocks.reweigh()
        rate = self.config.learning_rate * (self.config.final_learning_rate / self.config.learning_rate) ** fraction
        batch = self._bank.draw(self._rng, self._rays)
        skipped = self._skipped(fraction)
        late = replace(batch, origins=batch.origins + skipped[:, None] * batch.directions)
        errors, depths, evaluated = self.learn(late, self._rng.random(self._rays, dtype=np.float32), rate)
        whole = skipped == 0
        mse = float(errors[whole].mean()) / 3
        self._bank.blocks.learnt(batch.block[whole], errors[whole], depths[whole])
        self.steps += 1
        self.samples += evaluated
        self._wanted = self.config.samples_per_step * (1 + GROWTH * fraction)
        self._adapt(evaluated / self._rays)
        return mse

    def _skipped(self, fraction: float) -> np.ndarray:
        """How far from its camera each ray of a batch begins, (rays,) float32, most of them there.

        What explains an image by itself, a haze before the lens, then has no use: what is behind it is asked for too.
        """
        late = self._rng.random(self._rays, dtype=np.float32) < LATE * max(1 - fraction / UNTIL, 0)
        return late * self._rng.random(self._rays, dtype=np.float32) * np.float32(WITHIN * self._focus)

    def look_again(self) -> None:
        """Estimate the occupancy anew, at a part of the grid; at all of it the first time."""
        share = 1.0 if self.steps == 0 else (0.25 if self.steps < OFTEN else 1 / 8)
        self._occupancy.update(self.densities, share)
        self.occupancy_changed(self._occupancy.occupied)

    def look_for_missing(self) -> None:
        """Have cells marched through, until this is called again, where the images show what the field does not."""
        occupancy = self._occupancy
        occupancy.hold(missing(self._bank.blocks, self.space, occupancy.empty, self._rng))
        self.occupancy_changed(occupancy.occupied)

    def _adapt(self, samples_per_ray: float) -> None:
        wanted = self._wanted / max(samples_per_ray, 1.0)
        self._rays = int(np.clip(wanted, 0.8 * self._rays, 1.25 * self._rays + 1))
        self._rays = int(np.clip(self._rays, *RAYS))

    def run(self, report: Callable[[Progress], None]) -> tuple[int, float]:
        """Step until the time (or the number of steps) of the configuration is over; returns steps and seconds.

        KeyboardInterrupt passes through; the field is usable after it.
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


class Trainer(Learner):
    """Learns with the compiled kernels."""

    def __init__(self, views: list[View], space: Space, field: FieldConfig, config: TrainingConfig):
        super().__init__(views, space, field, config)
        self._net = new_net(field, self._rng)
        self._workers = Workers(field, config.threads, PACKET, ROWS, backward=True)
        self._optimiser = Optimiser(self._net, self._workers.threads)
        self.occupancy_changed(self._occupancy.occupied)
        self._compile()

    def _compile(self) -> None:
        """Meet the kernels once without work, so that compiling them takes no training time."""
        nothing = np.zeros((0, 3), np.float32)
        self.densities(nothing)
        none = np.zeros(0, np.float32)
        self._gradients(Batch(nothing, nothing, nothing, nothing, np.zeros(0, np.int64)), none, none, none)
        self._optimiser.compile()

    def net(self) -> Net:
        """See Learner."""
        return self._net

    def occupancy_changed(self, occupied: np.ndarray) -> None:
        """See Learner."""
        self._domain = domain_of(self.space, occupied)

    def densities(self, u: np.ndarray) -> np.ndarray:
        """See Learner."""
        out = np.empty(len(u), np.float32)
        self._workers.each(len(u), 4096, lambda s, a, b: densities(self._net, u, a, b, s.samples, out))
        return out

    def learn(self, batch: Batch, jitter: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray, int]:
        """See Learner."""
        errors, depths = np.zeros(len(jitter), np.float32), np.zeros(len(jitter), np.float32)
        evaluated = self._gradients(batch, jitter, errors, depths)
        self._optimiser.step(rate, self._workers)
        return errors, depths, evaluated

    def _gradients(self, batch: Batch, jitter: np.ndarray, errors: np.ndarray, depths: np.ndarray) -> int:
        n = len(jitter)
        # As many rays as fill the second-level cache with what the backward pass needs of their samples.
        packet = int(np.clip(PACKET_ROWS * n / self._wanted, 4, PACKET))
        delta, spread = np.float32(self.config.huber_delta), np.float32(self.distortion)
        done = self._workers.split(
            n,
            lambda s, a, b: train(
                self._net, self._domain, batch.origins, batch.directions, jitter, batch.background, batch.target,
                a, b, packet, PER_RAY, STOP_BELOW, delta, spread,
                np.float32(1 / max(n, 1)), s.samples, s.rays, self._optimiser.gradients[s.index], errors, depths,
            ),
        )  # fmt: skip
        return sum(done)  # type: ignore[arg-type]


def _distance_of_focus(views: list[View]) -> float:
    """Median distance of the cameras from what they look at, in object units."""
    poses = [v.cam_from_object for v in views]
    focus = nearest_point_to_axes(poses)
    return float(np.median([np.linalg.norm(camera_centre(pose) - focus) for pose in poses]))


def _before_lenses(views: list[View], space: Space, n: int) -> np.ndarray:
    """Cells (n, n, n) just in front of a camera, where haze would explain its image and hide the scene from others."""
    poses = [v.cam_from_object for v in views]
    focus = nearest_point_to_axes(poses)
    centres = [camera_centre(pose) for pose in poses]
    return near_cameras(space, n, [(c, FREE_SHARE * float(np.linalg.norm(c - focus))) for c in centres])


def psnr(mean_squared_error: float) -> float:
    """Peak signal-to-noise ratio in dB of colours in 0..1."""
    return float(-10 * np.log10(max(mean_squared_error, 1e-12)))


def colours(view: View, metadata: FieldMetadata) -> np.ndarray:
    """What a field should show for a view, (h, w, 3) in 0..1: transparent parts have the field's background."""
    image = view.image / 255.0
    if image.shape[2] == 3:
        return image
    return image[..., :3] * image[..., 3:] + (1 - image[..., 3:]) * np.array(metadata.background)


def evaluate(renderer: NumbaRenderer, views: list[View], every: int = 1) -> list[float]:
    """PSNR of each view over every so-manieth pixel that may be learnt from, its transparent parts over the field's
    background."""
    result = []
    for view in views:
        origins, directions = rays(view.camera, view.cam_from_object, view.camera.grid()[::every])
        rendered = renderer.render_rays(origins, directions).rgb
        truth = colours(view, renderer.metadata).reshape(-1, 3)[::every]
        counted = slice(None) if view.learnt is None else view.learnt.reshape(-1)[::every]
        errors = (rendered - truth)[counted] ** 2
        if len(errors):
            result.append(psnr(float(np.mean(errors))))
    return result
