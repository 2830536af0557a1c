"""How certain a pose is when neighbouring measurements err together.

The shape of a field and the place of a feature seen from elsewhere are wrong over whole regions, so that a thousand
matches tell less than a thousand independent ones. Each cell of the image has an offset in common beside the errors
of its own measurements: a random effect; Laird and Ware, Random-effects models for longitudinal data (1982).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from fieldpose.stages.geometry.arrays import Covariance, Jacobians, Pixels

_CELLS = 8
_LEAST = 1e-14


def twist_covariance(
    jacobian: Jacobians,
    weights: Float[np.ndarray, "n k k"],
    pixels: Pixels,
    longer_side: int,
    variance: float,
    shared: float,
) -> Covariance:
    """Covariance of the left twist that minimises weighted squared residuals, k of each of n > 0 pixels.

    weights: their inverse covariances up to a factor; variance: of a residual of weight 1; shared: variance of the
    offset that all residuals of a cell have; the image's longer side has eight cells. Directions that nothing
    determines have a huge variance.
    """
    weighted = weights @ jacobian
    inverse = _inverse(np.tensordot(weighted, jacobian, axes=((0, 1), (0, 1))))
    places = np.floor(pixels * (_CELLS / longer_side)).astype(int)
    _, cells = np.unique(places, axis=0, return_inverse=True)
    cells = cells.ravel()
    sums = np.zeros((cells.max() + 1, *jacobian.shape[1:]))
    np.add.at(sums, cells, weighted)
    together = np.tensordot(sums, sums, axes=((0, 1), (0, 1)))
    return variance * inverse + shared * inverse @ together @ inverse


def _inverse(hessian: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(hessian)
    return (vectors / np.maximum(values, _LEAST * max(float(values[-1]), 1e-300))) @ vectors.T
