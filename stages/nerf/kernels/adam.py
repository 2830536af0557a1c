"""Adam (Kingma and Ba, 2015) over the summed gradients of several threads, which it clears."""

from __future__ import annotations

import math

import numpy as np
from numba import njit


@njit(nogil=True, cache=True, fastmath={"contract", "nsz", "arcp"})
def adam_step(
    parameter: np.ndarray,
    gradients: tuple[np.ndarray, ...],
    mean: np.ndarray,
    square: np.ndarray,
    first: int,
    last: int,
    rate: float,
    beta1: float,
    beta2: float,
    epsilon: float,
    skip_zero: bool,
) -> None:
    """Update flat entries first..last; `rate` includes the bias correction.

    With `skip_zero` an entry without gradient keeps its moments, as Instant-NGP does for its tables.
    """
    one = np.float32(1)
    b1, b2, lr, eps = np.float32(beta1), np.float32(beta2), np.float32(rate), np.float32(epsilon)
    for i in range(first, last):
        g = np.float32(0)
        for gradient in gradients:
            g += gradient[i]
            gradient[i] = 0
        if skip_zero and g == 0:
            continue
        m = b1 * mean[i] + (one - b1) * g
        v = b2 * square[i] + (one - b2) * g * g
        mean[i], square[i] = m, v
        parameter[i] -= lr * m / (math.sqrt(v) + eps)
