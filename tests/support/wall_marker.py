"""A marker of known size on a wall of the papered room."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from support.papered_room import HALF

from fieldpose.stages.geometry import Camera
from fieldpose.stages.structure.markers import DICTIONARIES

SIZE = 0.6
NUMBER, BITS = 7, 240
MIDDLE = np.array([HALF - 0.001, 0.8, -0.3])
RIGHT, UP = np.array([0, -1.0, 0]), np.array([0, 0, 1.0])
CORNERS = MIDDLE + SIZE / 2 * np.array([-RIGHT + UP, RIGHT + UP, RIGHT - UP, -RIGHT - UP])


def with_marker(image: np.ndarray, camera: Camera, pose: np.ndarray, family: str = "4x4") -> np.ndarray:
    """The image with a marker in its white border on the wall, as the camera sees it, distortion and all."""
    aruco: Any = cv2.aruco
    dictionary = aruco.getPredefinedDictionary(getattr(aruco, DICTIONARIES[family]))
    pattern = aruco.generateImageMarker(dictionary, NUMBER, BITS)
    border = BITS // 6
    sheet = cv2.copyMakeBorder(pattern, border, border, border, border, cv2.BORDER_CONSTANT, value=255)
    rotation, offset = pose[:3, :3], pose[:3, 3]
    directions = camera.directions(camera.grid()).astype(np.float64) @ rotation
    centre = -rotation.T @ offset
    reach = (MIDDLE[0] - centre[0]) / directions[:, 0]
    points = centre + reach[:, None] * directions
    along = (points - MIDDLE) @ RIGHT / SIZE * BITS + len(sheet) / 2 - 0.5
    down = -(points - MIDDLE) @ UP / SIZE * BITS + len(sheet) / 2 - 0.5
    shape = image.shape[:2]
    maps = (along.astype(np.float32).reshape(shape), down.astype(np.float32).reshape(shape))
    painted = cv2.remap(sheet, *maps, cv2.INTER_LINEAR)
    half = len(sheet) / 2
    on_it = (np.abs(along - half) < half) & (np.abs(down - half) < half) & (reach > 0)
    result = image.copy()
    result[on_it.reshape(shape)] = painted[on_it.reshape(shape)][:, None]
    return result
