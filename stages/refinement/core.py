"""Refining a pose by colours, around the matched keypoints only: what hides the object has no keypoints on it.

The paper's section III-C (keypoint-guided occlusion-robust refinement).
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

from fieldpose.stages.geometry import Camera, scale_pixels
from fieldpose.stages.geometry.arrays import Covariance, Image, Pixels, Transform
from fieldpose.stages.images import shrunk_with_camera
from fieldpose.stages.nerf.rendering_api import RayRenderer
from fieldpose.stages.refinement import constants
from fieldpose.stages.refinement.config import RefinementConfig
from fieldpose.stages.refinement.optimisers import adam, levenberg_marquardt
from fieldpose.stages.refinement.photometric import Photometric, keypoint_region

__all__ = ["RefinementConfig", "RefinementResult", "refine"]

_MIN_PIXELS = 64


@dataclass(frozen=True)
class RefinementResult:
    """The better of the pose before and after, and the held-out loss of both (None where nothing was tried).

    Losses are robust, of colour differences in 0..1, on the same pixels with the same weights. covariance: of a refined
    pose, None of one that was left as it was.
    """

    cam_from_object: Transform
    refined: bool
    loss_before: float | None
    loss_after: float | None
    steps: int
    covariance: Covariance | None = None


def refine(
    renderer: RayRenderer,
    image: Image,
    camera: Camera,
    cam_from_object: Transform,
    keypoints_in_frame: Pixels,
    config: RefinementConfig | None = None,
) -> RefinementResult:
    """Refine the pose of a frame whose matched keypoints are given.

    Returns the pose unchanged, `refined` false, where the refined one is no better or there is nothing to compare. The
    same input gives the same result.
    """
    config = config or RefinementConfig()
    unchanged = RefinementResult(cam_from_object, False, None, None, 0)
    if not config.on:
        return unchanged
    image, camera, keypoints = _shrunk(image, camera, keypoints_in_frame, config.size)
    rng = _rng(config.seed, cam_from_object)
    pixels = rng.permutation(_candidates(keypoints, camera, config))
    held_out = min(config.held_out, len(pixels) // 3)
    if held_out < _MIN_PIXELS:
        return unchanged
    photometric = Photometric(renderer, config)
    judge = photometric.sample(image, camera, pixels[:held_out])
    opaque, distance = photometric.weighted_by_opacity(judge, cam_from_object)
    if distance == 0:
        return unchanged
    judge = opaque if config.background == "ignore" else judge
    before = photometric.loss(judge, cam_from_object)
    pool = photometric.sample(image, camera, pixels[held_out:])
    optimise = levenberg_marquardt if config.optimiser == "lm" else adam
    refined, steps = optimise(photometric, pool, cam_from_object, distance, rng, config)
    after = photometric.loss(judge, refined)
    if after >= before:
        return RefinementResult(cam_from_object, False, before, after, steps)
    covariance = photometric.covariance(judge, refined, camera, constants.SHARED_ERROR)
    return RefinementResult(refined, True, before, after, steps, covariance)


def _rng(seed: int, cam_from_object: np.ndarray) -> np.random.Generator:
    """Random numbers that depend on the input alone, and differ from pass to pass over a frame.

    The same pixels in each pass err in the same way: rotations of the lamp were then off by a fifth more.
    """
    pose = zlib.crc32(np.ascontiguousarray(cam_from_object, np.float64).tobytes())
    return np.random.default_rng((seed, pose))


def _shrunk(
    image: np.ndarray, camera: Camera, keypoints: np.ndarray, size: int
) -> tuple[np.ndarray, Camera, np.ndarray]:
    small_image, small = shrunk_with_camera(image, camera, size)
    if small is camera:
        return image, camera, keypoints
    scale = np.array([small.width / camera.width, small.height / camera.height])
    return small_image, small, scale_pixels(keypoints, scale)


def _candidates(keypoints: np.ndarray, camera: Camera, config: RefinementConfig) -> np.ndarray:
    if config.region == "image":
        return camera.grid()
    y, x = keypoint_region(keypoints, camera, config.dilations).nonzero()
    return np.stack([x, y], axis=1).astype(np.float32)
