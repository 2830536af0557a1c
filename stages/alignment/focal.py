"""Whether a camera's focal length is what it is said to be, by how residuals grow towards the image's edges."""

from __future__ import annotations

import numpy as np

from fieldpose.stages.alignment.least_squares import PoseFit

_SINGULAR = 1e-12


def focal_error(fit: PoseFit) -> tuple[float, float]:
    """How much longer the focal length is than said, as a share, and the standard deviation of that.

    A pose takes up most of what a wrong focal length does, but not what it does to points nearer and farther than
    most. (0, inf) where the points tell nothing of it.
    """
    residuals, jacobian = fit.errors
    from_centre = fit.pixels + residuals - (fit.camera.cx, fit.camera.cy)
    rows = np.concatenate([jacobian, from_centre[:, :, None]], axis=2)
    weighted = fit.weights @ rows
    hessian = np.tensordot(weighted, rows, axes=((0, 1), (0, 1)))
    pose, mixed, focal = hessian[:6, :6], hessian[:6, 6], hessian[6, 6]
    along = np.linalg.lstsq(pose, mixed, rcond=None)[0]
    left = float(focal - mixed @ along)
    if not left > _SINGULAR * max(float(focal), 1e-300):
        return 0.0, np.inf
    gradient = np.tensordot(weighted, residuals, axes=((0, 1), (0, 1)))
    return -float(gradient[6] - along @ gradient[:6]) / left, float(np.sqrt(fit.variance / left))
