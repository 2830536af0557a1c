"""A field in another frame and unit, without learning it anew."""

from __future__ import annotations

import msgspec
import numpy as np

from fieldpose.errors import ConfigError
from fieldpose.stages.geometry import Similarity, camera_centres, rays
from fieldpose.stages.nerf.datasets import find_name
from fieldpose.stages.nerf.metadata import CameraFit, FieldMetadata, Frame, PoseAccuracy, TrainingCamera
from fieldpose.stages.nerf.rendering_api import RayRenderer

METRE = "metre"
OWN_UNIT = "unit that was chosen for the field"
SOLID = 0.5
"""Opacity of a ray that meets a surface."""
_AROUND_PX = 4
_ASKED, _FEWEST = 40, 2
AGREE = 0.03
"""Of the distance, by which views may see a surface elsewhere: a can's is seen to 0.01, a plain floor's anywhere."""


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

    DatasetError where there is no such view; ConfigError where the pixel is outside, shows nothing, or what it shows is
    elsewhere for other views.
    """
    view = _view_named(metadata, name)
    if not (-0.5 <= x <= view.width - 0.5 and -0.5 <= y <= view.height - 0.5):
        raise ConfigError(f"pixel {x:g},{y:g} is not in {view.name}, which was learnt at {view.width}x{view.height}")
    origins, directions = rays(view.camera, view.pose, np.array([[x, y]]))
    traced = renderer.render_rays(origins.astype(np.float32), directions.astype(np.float32))
    if traced.opacity[0] < SOLID:
        raise ConfigError(f"{view.name} shows nothing solid at pixel {x:g},{y:g}; name another one")
    point: np.ndarray = origins[0] + float(traced.depth[0]) * directions[0]
    agreed, doubted = _seen_by_others(renderer, metadata, point)
    if agreed < max(_FEWEST, doubted):
        raise ConfigError(
            f"how far it is to what {view.name} shows at pixel {x:g},{y:g} is not known: {agreed} other views see a"
            f" surface there, {doubted} see past it; choose a place with texture"
        )
    return point


def texture_at(renderer: RayRenderer, metadata: FieldMetadata, name: str, x: float, y: float) -> float:
    """How much grey values (0 to 255) differ around a pixel of a training view, as a standard deviation.

    Of surfaces that look the same all over, no two images tell where they are.
    """
    view = _view_named(metadata, name)
    around = np.arange(-_AROUND_PX, _AROUND_PX + 1)
    pixels = np.stack(np.meshgrid(x + around, y + around), axis=-1).reshape(-1, 2)
    origins, directions = rays(view.camera, view.pose, pixels)
    seen = renderer.render_rays(origins.astype(np.float32), directions.astype(np.float32))
    return float(255 * seen.rgb.mean(axis=1).std())


def _view_named(metadata: FieldMetadata, name: str) -> TrainingCamera:
    names = [camera.name for camera in metadata.cameras]
    if not names:
        raise ConfigError(f"the field does not tell its training views, so {name} means nothing")
    return metadata.cameras[names.index(find_name(names, name))]


def _seen_by_others(renderer: RayRenderer, metadata: FieldMetadata, point: np.ndarray) -> tuple[int, int]:
    """How many training views see a surface at a point (3,), and how many see something behind it."""
    cameras = metadata.cameras[:: -(-len(metadata.cameras) // _ASKED)]
    centres = camera_centres(np.stack([camera.pose for camera in cameras]))
    within = np.array([_in_image(camera, point) for camera in cameras])
    if not within.any():
        return 0, 0
    traced = renderer.render_rays(centres[within].astype(np.float32), (point - centres[within]).astype(np.float32))
    solid = traced.opacity >= SOLID
    there = solid & (np.abs(traced.depth - 1) <= AGREE)
    past = (traced.depth > 1 + AGREE) | ~solid
    return int(there.sum()), int(past.sum())


def _in_image(view: TrainingCamera, point: np.ndarray) -> bool:
    in_cam = view.pose[:3, :3] @ point + view.pose[:3, 3]
    if in_cam[2] <= 0:
        return False
    x, y = view.camera.project(in_cam[None])[0]
    return bool(0 <= x < view.width and 0 <= y < view.height)


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
