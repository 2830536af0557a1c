"""Adam (Kingma and Ba, 2015) over the summed gradients of several threads, which it clears."""

from __future__ import annotations

import numpy as np
from numba import njit

from fieldpose.stages.kernel_cache import cached_njit

CHUNK = 64
ADAM_MATH = {"contract", "nsz", "arcp"}


@njit(nogil=True, fastmath=ADAM_MATH)
def gather(gradients: tuple[np.ndarray, ...], start: int, count: int, total: np.ndarray) -> bool:
    """Sum a chunk of the threads' gradients into `total` and clear it in them; whether there was anything.

    Memory is only written where it changes: most rows of the tables have no gradient in a step.
    """
    total[:count] = 0
    found = False
    for gradient in gradients:
        part = gradient[start : start + count]
        some = False
        for i in range(count):
            some |= part[np.uint64(i)] != 0
        if some:
            found = True
            for i in range(count):
                total[np.uint64(i)] += part[np.uint64(i)]
                part[np.uint64(i)] = 0
    return found


@njit(nogil=True, fastmath=ADAM_MATH)
def update(
    parameter: np.ndarray, mean: np.ndarray, square: np.ndarray, gradient: np.ndarray,
    rate: float, beta1: float, beta2: float, epsilon: float, skip_zero: bool,
) -> None:  # fmt: skip
    one = np.float32(1)
    for i in range(parameter.shape[0]):
        k = np.uint64(i)
        g, m, v = gradient[k], mean[k], square[k]
        stays = skip_zero and g == 0
        m = m if stays else beta1 * m + (one - beta1) * g
        v = v if stays else beta2 * v + (one - beta2) * g * g
        mean[k], square[k] = m, v
        parameter[k] -= np.float32(0) if stays else rate * m / (np.sqrt(v) + epsilon)


@cached_njit(nogil=True, fastmath=ADAM_MATH)
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
    total = np.empty(CHUNK, np.float32)
    for start in range(first, last, CHUNK):
        count = min(CHUNK, last - start)
        if gather(gradients, start, count, total) or not skip_zero:
            update(
                parameter[start : start + count], mean[start : start + count], square[start : start + count],
                total, np.float32(rate), np.float32(beta1), np.float32(beta2), np.float32(epsilon), skip_zero,
            )  # fmt: skip
