"""How certain a pose is when neighbouring measurements err together.

The shape of a field and the place of a feature seen from elsewhere are wrong over whole regions, so that a thousand
matches tell less than a thousand independent ones. Each cell of the image has an offset in common beside the errors
of its own measurements: a random effect; Laird and Ware, Random-effects models for longitudinal data (1982).
"""

from __future__ import annotations

import numpy as np

_CELLS = 8


def twist_covariance(
    jacobian: np.ndarray, weights: np.ndarray, pixels: np.ndarray, longer_side: int, variance: float, shared: float
) -> np.ndarray:
    """Covariance (6, 6) of the left twist that minimises weighted squared residuals.

    jacobian (n, k, 6) of k residuals of each of n pixels (n, 2); weights (n,), 1 / variance up to a factor;
    variance: of a residual of weight 1; shared: standard deviation of a cell's offset as a multiple of the mean
    residual's; the image's longer side has eight cells. Directions that nothing determines have no variance.
    """
    weighted = weights[:, None, None] * jacobian
    inverse = np.linalg.pinv(np.tensordot(weighted, jacobian, axes=((0, 1), (0, 1))), hermitian=True)
    places = np.floor(pixels * (_CELLS / longer_side)).astype(int)
    _, cells = np.unique(places, axis=0, return_inverse=True)
    cells = cells.ravel()
    sums = np.zeros((cells.max(initial=-1) + 1, *jacobian.shape[1:]))
    np.add.at(sums, cells, weighted)
    together = np.tensordot(sums, sums, axes=((0, 1), (0, 1))) * (shared**2 / max(float(weights.mean()), 1e-12))
    return variance * (inverse + inverse @ together @ inverse)
