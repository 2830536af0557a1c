"""The field in plain torch: the oracle of the compiled kernels, and what runs on CUDA.

Every function here computes the same as its namesake in `stages.nerf.kernels`, from the same arrays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from fieldpose.stages.nerf.field import LEARNT, Field
from fieldpose.stages.nerf.kernels.packet import MAX_EXPONENT
from fieldpose.stages.nerf.kernels.types import Net
from fieldpose.stages.nerf.metadata import Space

PRIME_Y, PRIME_Z = 2654435761, 805459861


@dataclass(frozen=True)
class TwinSamples:
    """Samples of all rays, (rays, most samples a ray), with `valid` where there is one."""

    t: Tensor
    dt: Tensor
    valid: Tensor


@dataclass(frozen=True)
class TwinRays:
    """Composited rays: rgb (n, 3) not clipped, depth (n,) in units of the unit direction, opacity (n,), weights."""

    rgb: Tensor
    depth: Tensor
    opacity: Tensor
    weights: Tensor


class TwinField(nn.Module):
    """A field whose learnt arrays are torch parameters."""

    table: Tensor
    w1: Tensor
    w2: Tensor
    c1: Tensor
    c2: Tensor
    c3: Tensor
    occupied: Tensor

    def __init__(self, net: Net, space: Space, occupied: np.ndarray, device: torch.device | str = "cpu"):
        super().__init__()
        self.space = space
        for name in LEARNT:
            self.register_parameter(name, nn.Parameter(torch.tensor(getattr(net, name), device=device)))
        self.offsets, self.resolutions = net.offsets.tolist(), net.resolutions.tolist()
        self.masks = net.masks.tolist()
        self.register_buffer("occupied", torch.tensor(occupied, device=device))

    @property
    def device(self) -> torch.device:
        """Where the parameters are."""
        return self.table.device

    def to_cube(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """(…, 3) normalised coordinates to the unit cube, and the growth (…,) of the step with distance."""
        if not self.space.contracted:
            return (y + 1) / 2, torch.ones_like(y[..., 0])
        r = y.norm(dim=-1, keepdim=True)
        scale = torch.where(r > 1, (2 - 1 / r.clamp(min=1)) / r.clamp(min=1), torch.ones_like(r))
        return y * scale / 4 + 0.5, r[..., 0].clamp(min=1)

    def encode(self, u: Tensor) -> Tensor:
        """(n, 3) in the unit cube to (n, levels * level_features)."""
        parts = []
        for offset, resolution, mask in zip(self.offsets, self.resolutions, self.masks, strict=True):
            scaled = u * resolution
            index = scaled.detach().long().clamp(0, resolution - 1)
            fraction = scaled - index
            total = u.new_zeros(len(u), self.table.shape[1])
            for corner in range(8):
                bits = torch.tensor([corner & 1, corner >> 1 & 1, corner >> 2], device=u.device)
                x, y, z = (index + bits).unbind(-1)
                if mask < 0:
                    row = x + (resolution + 1) * (y + (resolution + 1) * z)
                else:
                    row = (x ^ (y * PRIME_Y) ^ (z * PRIME_Z)) & mask
                weight = torch.where(bits.bool(), fraction, 1 - fraction).prod(dim=-1, keepdim=True)
                total = total + weight * self.table[offset + row]
            parts.append(total)
        return torch.cat(parts, dim=-1)

    def density_network(self, u: Tensor) -> Tensor:
        """(n, 3) to (n, 1 + features): the logarithm of the density, and the features."""
        return torch.relu(self.encode(u) @ self.w1) @ self.w2

    def densities(self, u: Tensor) -> Tensor:
        """(n, 3) to (n,)."""
        return self.density_network(u)[:, 0].clamp(max=float(MAX_EXPONENT)).exp()

    def is_occupied(self, u: Tensor) -> Tensor:
        """(…, 3) in the unit cube to (…,) bool."""
        n = self.occupied.shape[0]
        x, y, z = (u * n).long().clamp(0, n - 1).unbind(-1)
        return self.occupied[z, y, x]

    def march(self, origins: Tensor, directions: Tensor, jitter: Tensor) -> TwinSamples:
        """Every step of every ray within the domain, valid where its cell is occupied; unit directions."""
        near, far = self._clip(origins, directions)
        t = near + jitter * self.space.step
        ts, dts, valids = [], [], []
        while bool((t < far).any()):
            u, growth = self.to_cube(origins + t[:, None] * directions)
            dt = self.space.step * growth
            ts.append(t)
            dts.append(dt)
            valids.append((t < far) & self.is_occupied(u))
            t = t + dt
        if not ts:
            empty = torch.zeros(len(origins), 0, device=origins.device)
            return TwinSamples(empty, empty, empty.bool())
        return _compact(torch.stack(ts, 1), torch.stack(dts, 1), torch.stack(valids, 1))

    def _clip(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        near = torch.full_like(origins[:, 0], self.space.near)
        far = torch.full_like(near, self.space.far)
        corners = self.space.corners
        if corners is None:
            return near, far
        lowest, highest = torch.tensor(corners, dtype=origins.dtype, device=origins.device)
        parallel = directions.abs() < 1e-9
        safe = torch.where(parallel, torch.ones_like(directions), directions)
        first, second = (lowest - origins) / safe, (highest - origins) / safe
        inside = (lowest <= origins) & (origins <= highest)
        infinite = torch.full_like(first, 1e9)
        low = torch.where(parallel, torch.where(inside, -infinite, infinite), torch.minimum(first, second))
        high = torch.where(parallel, torch.where(inside, infinite, -infinite), torch.maximum(first, second))
        return torch.maximum(near, low.amax(1)), torch.minimum(far, high.amin(1))

    def forward(self, origins: Tensor, directions: Tensor, background: Tensor, samples: TwinSamples) -> TwinRays:
        """Composite (paper eq. 2 and 3) and shade; gradients flow to parameters, origins and directions."""
        positions = origins[:, None] + samples.t[..., None] * directions[:, None]
        out = origins.new_zeros(*samples.t.shape, self.w2.shape[1])
        if bool(samples.valid.any()):
            u, _ = self.to_cube(positions[samples.valid])
            out = out.index_put((samples.valid.nonzero(as_tuple=True)), self.density_network(u))
        sigma = out[..., 0].clamp(max=float(MAX_EXPONENT)).exp() * samples.valid
        passed = torch.cumsum(sigma * samples.dt, dim=1)
        after = torch.exp(-passed)
        before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], dim=1)[:, : after.shape[1]]
        weights = before - after
        opacity = weights.sum(1)
        features = (weights[..., None] * out[..., 1:]).sum(1)
        depth = surface(samples, before, after, weights, opacity)
        rest = torch.relu(torch.cat([features, harmonics(directions)], 1) @ self.c1)
        view_part = torch.relu(rest @ self.c2) @ self.c3
        o = opacity[:, None]
        return TwinRays(features[:, :3] + o * (view_part + 0.5) + (1 - o) * background, depth, opacity, weights)

    def to_net(self, like: Net) -> Net:
        """The learnt arrays back as numpy."""
        return like._replace(**{name: getattr(self, name).detach().cpu().numpy() for name in LEARNT})


def twin_of(field: Field, device: torch.device | str = "cpu") -> TwinField:
    """The twin of a field, with copies of its arrays."""
    return TwinField(field.net, field.metadata.space, field.occupied, device)


def surface(samples: TwinSamples, before: Tensor, after: Tensor, weights: Tensor, opacity: Tensor) -> Tensor:
    """Where half of the light is stopped (n,), the mean of what stops less, 0 where nothing does."""
    mean = (weights * samples.t).sum(1) / opacity.clamp(min=1e-4)
    mean = torch.where(opacity > 1e-4, mean, torch.zeros_like(mean))
    if samples.t.shape[1] == 0:
        return mean
    half = (before >= 0.5) & (after < 0.5) & samples.valid
    at = half.int().argmax(1, keepdim=True)
    t, dt, b, a = (v.gather(1, at)[:, 0] for v in (samples.t, samples.dt, before, after))
    share = torch.log(b / 0.5) / torch.log(b / a.clamp(min=1e-9))
    return torch.where(half.any(1), t + dt * (share - 0.5), mean)


def harmonics(d: Tensor) -> Tensor:
    """Real spherical harmonics of degree 0 to 3 of unit directions (n, 3): (n, 16)."""
    x, y, z = d.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    return torch.stack(
        [
            torch.full_like(x, 0.28209479), -0.48860251 * y, 0.48860251 * z, -0.48860251 * x,
            1.09254843 * x * y, -1.09254843 * y * z, 0.31539157 * (3 * zz - 1), -1.09254843 * x * z,
            0.54627422 * (xx - yy), 0.59004359 * y * (yy - 3 * xx), 2.89061144 * x * y * z,
            0.45704580 * y * (1 - 5 * zz), 0.37317633 * z * (5 * zz - 3), 0.45704580 * x * (1 - 5 * zz),
            1.44530572 * z * (xx - yy), 0.59004359 * x * (3 * yy - xx),
        ],
        dim=-1,
    )  # fmt: skip


def distortion_loss(samples: TwinSamples, weights: Tensor, contracted: bool) -> Tensor:
    """Sum over rays of sum_ij w_i w_j |s_i - s_j| (Barron et al., 2022)."""
    s = samples.t / (1 + samples.t) if contracted else samples.t
    apart = (s[:, :, None] - s[:, None, :]).abs()
    return torch.einsum("ri,rj,rij->", weights, weights, apart)


def _compact(t: Tensor, dt: Tensor, valid: Tensor) -> TwinSamples:
    """Move the valid samples of each ray to the front and cut to the longest ray."""
    order = torch.argsort((~valid).int(), dim=1, stable=True)
    most = int(valid.sum(1).max())
    order = order[:, :most]
    return TwinSamples(t.gather(1, order), dt.gather(1, order), valid.gather(1, order))
