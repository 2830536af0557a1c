"""The kinds of sources, one file each; a new kind is a file with an `open_…` function and a row in KINDS."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from fieldpose.errors import SourceError
from fieldpose.stages.camera.calibration import Calibrator
from fieldpose.stages.camera.config import CameraConfig
from fieldpose.stages.camera.core import Source
from fieldpose.stages.camera.sources.bag import open_bag
from fieldpose.stages.camera.sources.dataset import open_dataset
from fieldpose.stages.camera.sources.device import open_device
from fieldpose.stages.camera.sources.folder import open_folder
from fieldpose.stages.camera.sources.recording import open_recording
from fieldpose.stages.camera.sources.video import open_video
from fieldpose.stages.geometry import Camera


class Kind(NamedTuple):
    """How to open a source, given what stands after the colon; is_video: its frames follow one another in time;
    knows_truth: it may know its frames' true poses."""

    open: Callable[[str, CameraConfig, Calibrator], Source]
    example: str
    is_video: bool
    knows_truth: bool = False


KINDS: dict[str, Kind] = {
    "folder": Kind(open_folder, "folder:DIR", False),
    "dataset": Kind(open_dataset, "dataset:DIR:test", False, True),
    "video": Kind(open_video, "video:FILE", True),
    "camera": Kind(open_device, "camera:0", True),
    "mcap": Kind(open_recording, "mcap:FILE", True, True),
    "bag": Kind(open_bag, "bag:FILE", True),
}


EXTERNAL = "bus"
"""The source of a pipeline whose frames other programs send."""


def open_source(config: CameraConfig, known: Sequence[Camera] = ()) -> Source:
    """Open config.source; `known` are cameras of training views. Raises SourceError or another FieldposeError."""
    kind, rest = _parse(config.source)
    return kind.open(rest, config, Calibrator(config, known))


def is_video(source: str) -> bool:
    """Whether motion between the frames of such a source may be relied upon. Raises SourceError."""
    return source == EXTERNAL or _parse(source)[0].is_video


def knows_truth(source: str) -> bool:
    """Whether the true poses of such a source's frames may be known. Raises SourceError."""
    return source == EXTERNAL or _parse(source)[0].knows_truth


def _meant(source: str) -> str:
    """What a file or folder without its kind before it is likely to be."""
    path = Path(source)
    kind = "folder" if path.is_dir() else {".mcap": "mcap", ".bag": "bag"}.get(path.suffix, "video")
    return f"; is {kind}:{source} meant?" if source and path.exists() else ""


def _parse(source: str) -> tuple[Kind, str]:
    name, _, rest = source.partition(":")
    if name not in KINDS or not rest:
        examples = ", ".join([*(kind.example for kind in KINDS.values()), EXTERNAL])
        raise SourceError(f"source {source!r}: expected one of {examples}{_meant(source)}")
    return KINDS[name], rest
