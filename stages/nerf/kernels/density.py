"""Density at points, for the occupancy grid."""

from __future__ import annotations

import numpy as np

from fieldpose.stages.fastmath import FASTMATH
from fieldpose.stages.kernel_cache import cached_njit
from fieldpose.stages.nerf.kernels.packet import density, density_network
from fieldpose.stages.nerf.kernels.types import Net, Samples


@cached_njit(nogil=True, fastmath=FASTMATH)
def densities(net: Net, u: np.ndarray, first: int, last: int, samples: Samples, out: np.ndarray) -> None:
    """Fill out[first:last] with the density at u (n, 3) in the unit cube."""
    size = min(samples.t.shape[0], 256)
    for start in range(first, last, size):
        count = min(size, last - start)
        samples.u[:, :count] = u[start : start + count].T
        density_network(net, samples, np.int64(0), count)
        for s in range(count):
            out[start + s] = density(samples.out[s, 0])


@cached_njit(nogil=True)
def raise_to(estimate: np.ndarray, cells: np.ndarray, values: np.ndarray) -> None:
    """estimate[cells] = max(estimate[cells], values), also where a cell comes twice."""
    for i in range(cells.shape[0]):
        estimate[cells[i]] = max(estimate[cells[i]], values[i])
