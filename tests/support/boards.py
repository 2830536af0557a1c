"""Printed calibration boards as a camera sees them, drawn by OpenCV and by rays through every pixel."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np

from fieldpose.stages.geometry import Camera, rotation_about, unscale_pixels
from fieldpose.stages.structure.markers import DICTIONARIES

ACROSS, DOWN = 7, 5
_PIXELS, _BORDER = 96, 1
"""Of a square's side in the drawing, and of its white border in squares."""
_FINER = 2


def charuco(across: int = ACROSS, down: int = DOWN, family: str = "4x4", marker: float = 0.75) -> np.ndarray:
    """A ChArUco board in its white border, (h, w) uint8."""
    aruco: Any = cv2.aruco
    dictionary = aruco.getPredefinedDictionary(getattr(aruco, DICTIONARIES[family]))
    board = aruco.CharucoBoard((across, down), 1.0, marker, dictionary)
    return bordered(board.generateImage((across * _PIXELS, down * _PIXELS)))


def chess(across: int = ACROSS, down: int = DOWN) -> np.ndarray:
    """A chessboard in its white border, (h, w) uint8."""
    dark = (np.add.outer(np.arange(down), np.arange(across)) % 2 == 0).repeat(_PIXELS, 0).repeat(_PIXELS, 1)
    return bordered(np.where(dark, 0, 255).astype(np.uint8))


def bordered(board: np.ndarray) -> np.ndarray:
    border = _BORDER * _PIXELS
    return cv2.copyMakeBorder(board, border, border, border, border, cv2.BORDER_CONSTANT, value=255)


def poses(
    count: int, seed: int = 0, tilt_deg: float = 40.0, reach: float = 0.5, near: float = 6.0, tall: float = 0.75
) -> np.ndarray:
    """cam_from_board (count, 4, 4), lengths in squares: all over the picture, near and far, tilted to all sides.

    reach: tangent of the angle from the axis up to which the board's middle is, to the sides; tall: up and down, as a
    share of that.
    """
    rng = np.random.default_rng(seed)
    result = np.tile(np.eye(4), (count, 1, 1))
    for pose in result:
        around, tilt = rng.uniform(0, 2 * np.pi), np.deg2rad(tilt_deg) * rng.uniform(0.4, 1.0)
        turn = rotation_about(np.array([np.cos(around), np.sin(around), 0.0]), tilt)
        turn = turn @ rotation_about(np.array([0.0, 0.0, 1.0]), rng.uniform(-0.3, 0.3))
        aside = rng.uniform(-1, 1, 2)
        aside = np.sign(aside) * np.sqrt(np.abs(aside)) * (reach, tall * reach)
        middle = rng.uniform(near, 1.6 * near) * np.array([*aside, 1.0])
        pose[:3, :3] = turn[:3, :3]
        pose[:3, 3] = middle - turn[:3, :3] @ np.array([ACROSS / 2, DOWN / 2, 0.0])
    return result


def photograph(
    sheet: np.ndarray, lens: Lens, cam_from_board: np.ndarray, noise: float = 2.0, seed: int = 0
) -> np.ndarray:
    """The image (h, w, 3) uint8 of a sheet on grey, with light from one side."""
    towards = rays(lens) @ cam_from_board[:3, :3].astype(np.float32)
    centre = -cam_from_board[:3, :3].T @ cam_from_board[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = -centre[2] / towards[..., 2:]
        at = ((centre[:2] + reach * towards[..., :2] + _BORDER) * _PIXELS - 0.5).astype(np.float32)
    at[(reach[..., 0] <= 0) | ~np.isfinite(at).all(axis=2)] = -1e4
    at = np.clip(at, -1e4, 1e4)
    seen = cv2.remap(sheet, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=110)
    image = cv2.resize(seen, lens.size, interpolation=cv2.INTER_AREA).astype(np.float64)
    light = np.linspace(0.75, 1.0, image.shape[1])
    shaken = np.random.default_rng(seed).normal(0, noise, image.shape)
    grey = np.clip(np.rint((20 + 0.82 * image) * light + shaken), 0, 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


class Pinhole(NamedTuple):
    """A lens as fieldpose has it."""

    camera: Camera

    @property
    def size(self) -> tuple[int, int]:
        return self.camera.width, self.camera.height

    def directions(self, pixels: np.ndarray) -> np.ndarray:
        return self.camera.directions(pixels)


class Fisheye(NamedTuple):
    """An equidistant lens: the angle from the axis is proportional to the distance from the image's middle."""

    size: tuple[int, int]
    focal: float

    def directions(self, pixels: np.ndarray) -> np.ndarray:
        apart = (pixels - (np.array(self.size) - 1) / 2) / self.focal
        angle = np.linalg.norm(apart, axis=1, keepdims=True)
        return np.concatenate([apart * np.sinc(angle / np.pi), np.cos(angle)], axis=1)


Lens = Pinhole | Fisheye


@lru_cache(4)
def rays(lens: Lens) -> np.ndarray:
    """Directions (h, w, 3) float32 through the parts of every pixel."""
    width, height = lens.size
    x, y = np.meshgrid(np.arange(width * _FINER), np.arange(height * _FINER))
    pixels = unscale_pixels(np.stack([x.ravel(), y.ravel()], axis=1), np.array([_FINER, _FINER]))
    return lens.directions(pixels).astype(np.float32).reshape(height * _FINER, width * _FINER, 3)
