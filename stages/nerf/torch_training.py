"""Learn a field with torch: on CUDA, and as what the kernels' speed is compared with."""

from __future__ import annotations

import numpy as np
import torch
from torch.nn.functional import huber_loss

from fieldpose.stages.nerf.blocks import View
from fieldpose.stages.nerf.config import FieldConfig, TrainingConfig
from fieldpose.stages.nerf.field import new_net
from fieldpose.stages.nerf.kernels.types import Net
from fieldpose.stages.nerf.metadata import Space
from fieldpose.stages.nerf.optimiser import BETA1, BETA2, EPSILON
from fieldpose.stages.nerf.raybank import Batch
from fieldpose.stages.nerf.training import Learner
from fieldpose.stages.nerf.twin import TwinField, distortion_loss

DENSITY_CHUNK = 1 << 18


class TorchTrainer(Learner):
    """Learns with the plain twin and torch's own Adam; takes the same batches as the kernels."""

    def __init__(
        self, views: list[View], space: Space, field: FieldConfig, config: TrainingConfig, device: torch.device
    ):
        super().__init__(views, space, field, config)
        self._template = new_net(field, self._rng)
        self._twin = TwinField(self._template, self.space, self._occupancy.occupied, device)
        self._adam = torch.optim.Adam(
            self._twin.parameters(), lr=config.learning_rate, betas=(BETA1, BETA2), eps=EPSILON
        )

    def net(self) -> Net:
        """See Learner; a copy."""
        return self._twin.to_net(self._template)

    def occupancy_changed(self, occupied: np.ndarray) -> None:
        """See Learner."""
        self._twin.occupied = torch.tensor(occupied, device=self._twin.device)

    def densities(self, u: np.ndarray) -> np.ndarray:
        """See Learner."""
        with torch.inference_mode():
            parts = [self._twin.densities(part).cpu() for part in self._tensor(u).split(DENSITY_CHUNK)]
        return torch.cat(parts).numpy()

    def learn(self, batch: Batch, jitter: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray, int]:
        """See Learner."""
        for group in self._adam.param_groups:
            group["lr"] = rate
        origins, directions, target, background = (
            self._tensor(a) for a in (batch.origins, batch.directions, batch.target, batch.background)
        )
        with torch.no_grad():
            samples = self._twin.march(origins, directions, self._tensor(jitter))
        rays = self._twin(origins, directions, background, samples)
        loss = huber_loss(rays.rgb, target, reduction="sum", delta=self.config.huber_delta)
        loss = loss + self.distortion * distortion_loss(samples, rays.weights, self.space.contracted)
        self._adam.zero_grad()
        (loss / len(jitter)).backward()
        self._adam.step()
        errors = ((rays.rgb.detach() - target) ** 2).sum(dim=1)
        depths = torch.where(rays.opacity.detach() > 0.5, rays.depth.detach(), 0)
        return errors.cpu().numpy(), depths.cpu().numpy(), int(samples.valid.sum())

    def _tensor(self, array: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(array, device=self._twin.device)
