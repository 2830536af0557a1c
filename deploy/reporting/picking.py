"""A page on which points of a field are clicked, and which puts the command together that makes use of them."""

from __future__ import annotations

import base64
import json
import shlex
from pathlib import Path
from typing import Any

import numpy as np

from fieldpose.deploy.framing import PLAIN
from fieldpose.deploy.reporting.overlay import encoded
from fieldpose.errors import ConfigError
from fieldpose.stages.geometry import inverse
from fieldpose.stages.nerf.framing import AGREE, SOLID
from fieldpose.stages.nerf.metadata import FieldMetadata
from fieldpose.stages.nerf.rendering_api import RayRenderer, RenderedView

_VIEWS = 12
_LONGER_SIDE = 640
_LEVELS = 65534
"""Of depths, of 16 bits; 0 is where nothing is."""
_TEMPLATE = Path(__file__).with_name("picking.html")
_PLACE = "/*VIEWS*/null"


def page(renderer: RayRenderer, metadata: FieldMetadata, path: Path) -> bytes:
    """The page (HTML, UTF-8), which asks nothing from elsewhere. ConfigError where the field has no training views."""
    if not metadata.cameras:
        raise ConfigError(f"{path}: the field does not tell its training views, of which the page would be made")
    views = [
        {"name": view.name, **_view(renderer.render_view(view.camera.undistorted().shrunk(_LONGER_SIDE), view.pose))}
        for view in metadata.cameras[:: -(-len(metadata.cameras) // _VIEWS)]
    ]
    known = {"views": views, "field": shlex.quote(str(path)), "metres_per_unit": metadata.metres_per_unit}
    known |= {"plain": PLAIN, "agree": AGREE}
    # "<" might close the script that the values stand in.
    text = json.dumps(known).replace("<", "\\u003c")
    return _TEMPLATE.read_text(encoding="utf-8").replace(_PLACE, text).encode()


def _view(view: RenderedView) -> dict[str, Any]:
    solid = view.opacity >= SOLID
    near, far = (float(view.depth[solid].min()), float(view.depth[solid].max())) if solid.any() else (0.0, 1.0)
    step = max(far - near, 1e-9) / _LEVELS
    levels = np.where(solid, np.rint((view.depth - near) / step) + 1, 0).astype("<u2")
    camera = view.camera
    return {
        "size": [camera.width, camera.height],
        "lens": [camera.fx, camera.fy, camera.cx, camera.cy],
        "object_from_cam": inverse(view.cam_from_object)[:3].ravel().tolist(),
        "near": near,
        "step": step,
        "depth": base64.b64encode(levels.tobytes()).decode(),
        "image": "data:image/jpeg;base64," + base64.b64encode(encoded(view.rgb, Path("view.jpg"))).decode(),
    }
