"""Small views of the scene of wires and rods that recordings/wires makes."""

from __future__ import annotations

import importlib.util
import sys
from functools import cache
from pathlib import Path
from types import ModuleType

import numpy as np

from fieldpose.stages.geometry import Camera
from fieldpose.stages.nerf.blocks import View

OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


@cache
def scene() -> ModuleType:
    """The script that makes the scene."""
    path = Path(__file__).parents[2] / "recordings" / "wires" / "make_scene.py"
    spec = importlib.util.spec_from_file_location("wires_scene", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@cache
def wires(count: int = 32, size: int = 100) -> tuple[View, ...]:
    """RGBA views from all around, with wires of one to two pixels."""
    made = scene()
    views = made.Views(size=size, thickness=400 / size * 0.9)
    rng = np.random.default_rng(1)
    camera = Camera(size, size, views.focal, views.focal, (size - 1) / 2, (size - 1) / 2)
    result = []
    for i in range(count):
        world_from_camera = made.pose(rng, views.distance)
        image = made.straight(made.picture(world_from_camera, views, False))[..., [2, 1, 0, 3]]
        result.append(View(f"{i}", image, camera, OPENCV_FROM_OPENGL @ np.linalg.inv(world_from_camera)))
    return tuple(result)
