"""Where a camera is relative to an object or scene known only from posed photographs.

Poses are 4x4 float64 `cam_from_object` matrices in OpenCV camera axes (x right, y down, z forward); images are
(h, w, 3) uint8 RGB; pixel (0, 0) is the centre of the top-left pixel; lengths are in the field's unit.

    finder = fieldpose.PoseFinder("mine.safetensors")       # a field of `fieldpose train`
    found = finder.find(image)                              # found.cam_from_object, found.covariance, found.reason

    with fieldpose.connect() as pipeline:                   # of `fieldpose run … --listen tcp/127.0.0.1:7447`
        for state in pipeline.states():
            print(state.state, state.cam_from_object)

Nothing is imported before it is used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from os import PathLike

    from fieldpose.bus.messages import CameraOrigin, Reason, State, TrackingState
    from fieldpose.bus.requests import ControlValues
    from fieldpose.connection import Connection, connect
    from fieldpose.deploy.local import PoseFound
    from fieldpose.deploy.settings import Settings, read_settings
    from fieldpose.errors import FieldposeError
    from fieldpose.finder import PoseFinder
    from fieldpose.learning import train
    from fieldpose.stages.geometry import Camera
    from fieldpose.stages.nerf.field import Field
    from fieldpose.stages.nerf.loading import make_renderer
    from fieldpose.stages.nerf.rendering_api import RayRenderer, RenderedView

_WHERE = {
    "Camera": "stages.geometry",
    "CameraOrigin": "bus.messages",
    "Connection": "connection",
    "ControlValues": "bus.requests",
    "Field": "stages.nerf.field",
    "FieldposeError": "errors",
    "PoseFinder": "finder",
    "PoseFound": "deploy.local",
    "RayRenderer": "stages.nerf.rendering_api",
    "Reason": "bus.messages",
    "RenderedView": "stages.nerf.rendering_api",
    "Settings": "deploy.settings",
    "State": "bus.messages",
    "TrackingState": "bus.messages",
    "connect": "connection",
    "make_renderer": "stages.nerf.loading",
    "read_settings": "deploy.settings",
    "train": "learning",
}

__all__ = [
    "Camera", "CameraOrigin", "Connection", "ControlValues", "Field", "FieldposeError", "PoseFinder", "PoseFound",
    "RayRenderer", "Reason", "RenderedView", "Settings", "State", "TrackingState", "connect", "load_field",
    "make_renderer", "read_settings", "train",
]  # fmt: skip


def load_field(path: str | PathLike[str]) -> Field:
    """A trained field from its file. Raises FieldposeError."""
    from pathlib import Path

    from fieldpose.stages.nerf.field import load_field as load

    return load(Path(path))


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module 'fieldpose' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"fieldpose.{_WHERE[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
