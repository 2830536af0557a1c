"""The similarity that brings cameras into the frame and the unit of others, where some of both are wrong."""

from __future__ import annotations

import numpy as np

from fieldpose.stages.geometry import Similarity, camera_centres
from fieldpose.stages.geometry.arrays import Transforms
from fieldpose.stages.geometry.rigid import skew

_STEPS = 50
_CONVERGED = 1e-12


def align(cam_from_source: Transforms, cam_from_target: Transforms) -> Similarity:
    """The similarity after which the cameras (n, 4, 4) are where and as turned as the others are, but for outliers.

    Centres and rotations both count, each by its own median error, so that cameras along a line, or all in one place,
    have a frame too; in one place the scale stays. The errors are taken to be the target's.
    """
    from scipy.spatial.transform import Rotation

    sources, targets = camera_centres(cam_from_source), camera_centres(cam_from_target)
    # target_from_source of each camera alone
    turns = np.einsum("nji,njk->nik", cam_from_target[:, :3, :3], cam_from_source[:, :3, :3])
    rotation, scale = Rotation.from_matrix(turns).mean().as_matrix(), _ratio(sources, targets)
    translation = np.median(targets - scale * sources @ rotation.T, axis=0)
    for _ in range(_STEPS):
        turned = scale * sources @ rotation.T
        apart = targets - turned - translation
        askew = Rotation.from_matrix(turns @ rotation.T).as_rotvec()
        step = _step(turned, apart, askew)
        rotation = Rotation.from_rotvec(step[:3]).as_matrix() @ rotation
        translation = translation + step[4:]
        scale *= float(np.exp(step[3]))
        if np.abs(step).max() < _CONVERGED:
            break
    return Similarity(scale, rotation, translation)


def _ratio(sources: np.ndarray, targets: np.ndarray) -> float:
    """Of how far the targets are spread to how far the sources are; 1 where these are all in one place."""
    spread = [float(np.median(np.linalg.norm(c - np.median(c, axis=0), axis=1))) for c in (sources, targets)]
    return spread[1] / spread[0] if min(spread) > 0 else 1.0


def _step(turned: np.ndarray, apart: np.ndarray, askew: np.ndarray) -> np.ndarray:
    """(7,): a small rotation from the left, the change of the scale's logarithm, that of the translation."""
    normal, right = np.zeros((7, 7)), np.zeros(7)
    for point, place, turn, by_place, by_turn in zip(
        turned, apart, askew, _weights(apart), _weights(askew), strict=True
    ):
        jacobian = np.concatenate([-skew(point), point[:, None], np.eye(3)], axis=1)
        normal += by_place * jacobian.T @ jacobian
        right += by_place * jacobian.T @ place
        normal[:3, :3] += by_turn * np.eye(3)
        right[:3] += by_turn * turn
    size = np.sqrt(np.where(np.diag(normal) > 0, np.diag(normal), 1.0))
    return np.linalg.lstsq(normal / np.outer(size, size), right / size, rcond=1e-12)[0] / size


def _weights(residuals: np.ndarray) -> np.ndarray:
    """Of residuals (n, 3): one over the square of their median length, less for those that are longer."""
    length = np.linalg.norm(residuals, axis=1)
    typical = max(float(np.median(length)), 1e-12)
    return 1 / (typical * np.maximum(length, typical))
