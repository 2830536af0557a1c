"""A right message of any type, made from what its fields say."""

from __future__ import annotations

import types
import typing
from enum import Enum
from typing import Any

import numpy as np

from fieldpose.bus.messages import Checked, Header
from fieldpose.stages.geometry import Camera

_CAMERA = Camera(8, 6, 9.0, 9.0, 3.5, 2.5, (0.1, 0.0, 0.0, 0.0, 0.0))


def sample(kind: type[Checked]) -> Checked:
    """Matrices are identities, images 8x6, and where there may be something, it is there."""
    hints = typing.get_type_hints(kind)
    return kind(**{name: _value(kind, name, hints[name]) for name in kind.__struct_fields__})


def _value(kind: type[Checked], name: str, hint: Any) -> Any:
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return _value(kind, name, typing.get_args(hint)[0])
    if typing.get_origin(hint) is typing.Literal:
        return typing.get_args(hint)[0]
    if hint is np.ndarray:
        dtype, shape = kind._arrays.get(name, ("uint8", (None, None, 3)))
        sizes = [n or given for n, given in zip(shape, (_CAMERA.height, _CAMERA.width, 3), strict=False)]
        return np.eye(sizes[0], sizes[1]).astype(dtype) if len(sizes) == 2 else np.zeros(sizes, dtype)
    if isinstance(hint, type) and issubclass(hint, Enum):
        return next(iter(hint))
    fixed = {Camera: _CAMERA, Header: Header("x", 1, 3, 1, 1003, 1004), str: "x", int: 1, float: 0.5, bool: True}
    return fixed[hint]
