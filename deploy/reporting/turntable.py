"""A short video of what a field has learnt."""

from __future__ import annotations

from pathlib import Path

from fieldpose.deploy.reporting.output import check_writable
from fieldpose.errors import ConfigError, OutputError
from fieldpose.stages.nerf.metadata import FieldMetadata
from fieldpose.stages.nerf.rendering_api import RayRenderer

_RATE_HZ, _FRAMES, _LONGER_SIDE = 20.0, 60, 400


def check_video(path: Path | None) -> None:
    """Raise OutputError where a video could not be written later, for its place or its name."""
    check_writable(path)
    if path is not None and path.suffix != ".mp4":
        raise OutputError(f"{path}: no name of a video; end it in .mp4")


def write_turntable(renderer: RayRenderer, metadata: FieldMetadata, path: Path) -> None:
    """Three seconds around the object, or along training views, as stages.nerf.tour has it, as .mp4.

    Raises OutputError, and ConfigError where the field tells of no training views.
    """
    # OpenCV takes a while to import, which asking for help does without.
    from fieldpose.deploy.reporting.overlay import VideoFile
    from fieldpose.stages.nerf.tour import tour

    if not metadata.cameras:
        raise ConfigError("the field does not tell its training views, along which a turntable goes")
    way = tour(metadata, _FRAMES, _LONGER_SIDE)
    pictures = [renderer.render_view(way.camera, pose).rgb for pose in way.poses]
    video = VideoFile(path, _RATE_HZ, way.camera.width, way.camera.height)
    for i in way.order:
        video.add(pictures[i], 1)
    video.close()
