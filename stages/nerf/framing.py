"""A field in another frame and unit, without learning it anew."""

from __future__ import annotations

import msgspec
import numpy as np

from fieldpose.errors import ConfigError
from fieldpose.stages.geometry import Similarity, rays
from fieldpose.stages.nerf.datasets import find_name
from fieldpose.stages.nerf.metadata import CameraFit, FieldMetadata, Frame, PoseAccuracy, TrainingCamera
from fieldpose.stages.nerf.rendering_api import RayRenderer

METRE = "metre"
OWN_UNIT = "unit that was chosen for the field"
SOLID = 0.5
"""Opacity of a ray that meets a surface."""


def reframed(metadata: FieldMetadata, new_from_old: Similarity) -> FieldMetadata:
    """What a field says of itself in a new frame and unit; what it shows is the same, where it is, is not.

    All poses and lengths go along, a known length of the unit as well, and the way from the dataset's frame is kept.
    """
    scale, turn = new_from_old.scale, new_from_old.rotation
    space = metadata.space
    left, _, right = np.linalg.svd(space.turn @ turn.T)
    moved = new_from_old.of_points(np.array([space.centre]))[0]
    metres = metadata.metres_per_unit
    return msgspec.structs.replace(
        metadata,
        space=msgspec.structs.replace(
            space,
            centre=tuple(moved.tolist()),
            scale=space.scale * scale,
            rotation=tuple((left @ right).ravel().tolist()),
        ),
        cameras=_moved(metadata.cameras, new_from_old),
        frame=_changed(metadata, new_from_old),
        metres_per_unit=None if metres is None else metres / scale,
        accuracy=_accuracy(metadata.accuracy, scale),
        camera_fit=_fit(metadata.camera_fit, scale),
    )


def in_dataset_frame(metadata: FieldMetadata) -> FieldMetadata:
    """What a field says of itself in the frame and unit of its dataset."""
    given = metadata.frame
    if given.unit is None:
        return metadata
    back = reframed(metadata, given.object_from_dataset.inverse())
    return msgspec.structs.replace(back, frame=Frame(), unit=given.unit, metres_per_unit=given.metres_per_unit)


def shown_at(renderer: RayRenderer, metadata: FieldMetadata, name: str, x: float, y: float) -> np.ndarray:
    """The point (3,) of the surface that a training view shows at a pixel, by the size that it was learnt at.

    DatasetError where there is no such view; ConfigError where the pixel is outside, or shows nothing.
    """
    names = [camera.name for camera in metadata.cameras]
    if not names:
        raise ConfigError(f"the field does not tell its training views, so {name}:{x:g},{y:g} means nothing")
    view = metadata.cameras[names.index(find_name(names, name))]
    if not (-0.5 <= x <= view.width - 0.5 and -0.5 <= y <= view.height - 0.5):
        raise ConfigError(f"pixel {x:g},{y:g} is not in {view.name}, which was learnt at {view.width}x{view.height}")
    origins, directions = rays(view.camera, view.pose, np.array([[x, y]]))
    traced = renderer.render_rays(origins.astype(np.float32), directions.astype(np.float32))
    if traced.opacity[0] < SOLID:
        raise ConfigError(f"{view.name} shows nothing solid at pixel {x:g},{y:g}; name another one")
    point: np.ndarray = origins[0] + float(traced.depth[0]) * directions[0]
    return point


def _changed(metadata: FieldMetadata, new_from_old: Similarity) -> Frame:
    whole = new_from_old.after(metadata.frame.object_from_dataset)
    rotation, translation = whole.rotation.ravel().tolist(), whole.translation.tolist()
    before = metadata.frame
    unit, metres = metadata.unit, metadata.metres_per_unit
    unit, metres = (unit, metres) if before.unit is None else (before.unit, before.metres_per_unit)
    return Frame(whole.scale, tuple(rotation), tuple(translation), unit, metres)


def _moved(cameras: list[TrainingCamera], new_from_old: Similarity) -> list[TrainingCamera]:
    if not cameras:
        return []
    poses = new_from_old.of_poses(np.stack([camera.pose for camera in cameras]))
    return [
        msgspec.structs.replace(camera, cam_from_object=tuple(pose.ravel().tolist()))
        for camera, pose in zip(cameras, poses, strict=True)
    ]


def _accuracy(accuracy: PoseAccuracy | None, scale: float) -> PoseAccuracy | None:
    return accuracy and msgspec.structs.replace(accuracy, translation=accuracy.translation * scale)


def _fit(fit: CameraFit | None, scale: float) -> CameraFit | None:
    if fit is None or fit.translation is None:
        return fit
    median, most = fit.translation
    return msgspec.structs.replace(fit, translation=(median * scale, most * scale))
