"""iNeRF: descent of the colour difference from one guess.

Source: Yen-Chen et al., iNeRF: Inverting Neural Radiance Fields for Pose Estimation (IROS 2021). From the publication:
the mean squared error of RGB; rays from the interest region, which is the keypoints dilated three times by 5 x 5
pixels; the pose exp(S theta) @ T0 with T0 object_from_cam, so that turns are about the object's origin, and descent of
the accumulated S theta; Adam with betas 0.9 and 0.999 and the learning rate 0.01 * 0.8 ** (step / 100); 300 steps; SIFT
keypoints, as in the public PyTorch code. Chosen here: S theta is one vector of six that starts at zero (published:
within 1e-6 of it); 512 rays a step (published: 2048), for a CPU; without an early end, the last pose is the answer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import cv2
import numpy as np

from fieldpose.deploy.evaluation.baselines.descent import Adam, left_jacobian, rendered_with
from fieldpose.stages.geometry import Camera, exp_se3, inverse, twist_gradient
from fieldpose.stages.nerf.rendering_api import RayRenderer
from fieldpose.stages.refinement.photometric import keypoint_region

_BETA2 = 0.999


@dataclass(frozen=True)
class InerfConfig:
    """Settings; learning_rate is in radians and units of the dataset."""

    rays: int = 512
    steps: int = 300
    learning_rate: float = 0.01
    decay: float = 0.8
    """of the learning rate in 100 steps"""
    dilations: int = 3


class Inerf:
    """Finds a pose by descent from the guess; the same seed gives the same answer."""

    scale_known: ClassVar[bool] = True

    def __init__(self, renderer: RayRenderer, config: InerfConfig | None = None, seed: int = 0) -> None:
        self._renderer, self._config, self._seed = renderer, config or InerfConfig(), seed

    def find(self, image: np.ndarray, camera: Camera, guess: np.ndarray) -> np.ndarray | None:
        """cam_from_object (4, 4) of an image (h, w, 3) uint8 from a guess of it; None if no keypoints are seen."""
        region = interest_region(image, camera, self._config.dilations)
        if len(region) == 0:
            return None
        x, y = region.T
        directions, colours = camera.directions(region), image[y, x].astype(np.float32) / 255
        start, rng = inverse(guess), np.random.default_rng(self._seed)
        twist, adam = np.zeros(6), Adam((6,), _BETA2)
        for step in range(self._config.steps):
            chosen = rng.choice(len(region), min(self._config.rays, len(region)), replace=False)
            _, gradient = squared_error(self._renderer, start, twist, directions[chosen], colours[chosen])
            rate = self._config.learning_rate * self._config.decay ** (step / 100)
            twist += rate * adam.step(gradient)
        return inverse(exp_se3(twist) @ start)


def interest_region(image: np.ndarray, camera: Camera, dilations: int) -> np.ndarray:
    """Pixels (n, 2) int, as (x, y), near the SIFT keypoints of an image (h, w, 3) uint8."""
    create: Any = cv2.SIFT_create  # type: ignore[attr-defined]  # missing from OpenCV's stubs
    found = create().detect(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None)
    keypoints = np.array([keypoint.pt for keypoint in found]).reshape(-1, 2)
    return np.argwhere(keypoint_region(keypoints, camera, dilations))[:, ::-1]


def squared_error(
    renderer: RayRenderer, start: np.ndarray, twist: np.ndarray, directions: np.ndarray, colours: np.ndarray
) -> tuple[float, np.ndarray]:
    """The mean squared error of rays at exp_se3(twist) @ start, and its gradient (6,) by the twist.

    start: object_from_cam (4, 4).  directions: (n, 3) in the camera.  colours: (n, 3) in 0..1.
    """
    object_from_cam = exp_se3(twist) @ start
    turned = directions @ object_from_cam[:3, :3].T
    origins = np.broadcast_to(object_from_cam[:3, 3], turned.shape)
    rendered, jacobian = rendered_with(renderer, origins, turned)
    residuals = (rendered.rgb - colours).astype(np.float64)
    by_ray = np.einsum("nk,nkj->nj", residuals, jacobian) * (2 / residuals.size)
    gradient = twist_gradient(origins, turned, by_ray).sum(axis=0)
    return float((residuals**2).mean()), left_jacobian(twist).T @ gradient
