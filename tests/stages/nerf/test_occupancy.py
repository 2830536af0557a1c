"""The finer occupancy of a field that has been learnt."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldpose.stages.nerf.occupancy import finer


def fog(seed: int):  # type: ignore[no-untyped-def]
    """Densities of a few soft balls in the unit cube."""
    rng = np.random.default_rng(seed)
    centres, radii = rng.random((4, 3)), rng.uniform(0.05, 0.3, 4)

    def densities(u: np.ndarray) -> np.ndarray:
        distance = np.linalg.norm(u[:, None] - centres, axis=2)
        return (40 * np.maximum(1 - distance / radii, 0).max(axis=1)).astype(np.float32)

    return densities


@given(st.integers(0, 2**32 - 1), st.floats(0.01, 0.3))
@settings(max_examples=20, deadline=None)
def test_half_cells_are_kept_by_what_is_in_them(seed: int, least: float) -> None:
    """Against a plain twin that goes from cell to cell."""
    densities, step = fog(seed), 0.02
    occupied = np.random.default_rng(seed).random((4, 4, 4)) < 0.6
    found = finer(occupied, densities, step, least)
    inside = np.stack(np.meshgrid(*[(np.arange(3) + 0.5) / 3] * 3, indexing="ij"), -1).reshape(-1, 3)
    for z, y, x in np.ndindex(8, 8, 8):
        points = (np.array([x, y, z]) + inside) / 8
        opacity = 1 - np.exp(-float(densities(points.astype(np.float32)).max()) * step)
        if abs(opacity - least) > 1e-5:
            assert found[z, y, x] == (occupied[z // 2, y // 2, x // 2] and opacity >= least)
