"""The layout that shows everything which is written and served, for Foxglove and Lichtblick, which import it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any, cast

import numpy as np

from fieldpose.bus.messages import Correspondences
from fieldpose.bus.reading import read_recording
from fieldpose.bus.topics import CORRESPONDENCES, Address

_FILE = Path(__file__).parent / "layout.json"
_DISTANCE = 4.0
"""From the cameras to what they look at, in the lengths that the file has."""
_LENGTHS = {"distance", "size", "axisScale", "arrowScale", "near", "far", "maxValue"}
_SOLVES = 50


def layout(distance: float = _DISTANCE) -> bytes:
    """It, with all lengths for cameras that are so far from what they look at, in the field's unit."""
    return json.dumps(_scaled(json.loads(_FILE.read_bytes()), distance / _DISTANCE), indent=1).encode()


def recorded_distance(recording: Path, address: Address | None) -> float:
    """How far cameras are from what they look at, in a pipeline or in all; that of the layout's file if none is told.

    Raises RecordingError for a file that is no whole recording.
    """
    solves = islice(_lifted(recording, address), _SOLVES)
    depths = [depth for found in solves for depth in (_depths(found),) if len(depth)]
    return float(np.median(np.concatenate(depths))) if depths else _DISTANCE


def _lifted(recording: Path, address: Address | None) -> Iterator[Correspondences]:
    for recorded in read_recording(recording, (CORRESPONDENCES,)):
        if address is None or address.covers(recorded.key):
            yield cast(Correspondences, recorded.message)


def _depths(found: Correspondences) -> np.ndarray:
    row = found.view_cam_from_object[2]
    depths = found.points_in_object[found.kept].astype(np.float64) @ row[:3] + row[3]
    return np.asarray(depths[depths > 0])


def _scaled(value: Any, factor: float, is_length: bool = False) -> Any:
    if isinstance(value, dict):
        return {key: _scaled(inner, factor, _is_length(key, value)) for key, inner in value.items()}
    if isinstance(value, list):
        return [_scaled(inner, factor, is_length) for inner in value]
    return float(f"{value * factor:.6g}") if is_length else value


def _is_length(key: str, settings: dict[str, Any]) -> bool:
    """Lines of a way are as wide as things of the scene, those of a grid so many pixels."""
    return key in _LENGTHS or (key == "lineWidth" and settings.get("type") == "line")
