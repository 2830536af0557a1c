"""The scene in 3-D: the field's surface, training cameras, the camera with its way, lifted points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import viser
from scipy.spatial.transform import Rotation

from fieldpose.bus.messages import TrackingState
from fieldpose.deploy.viewing.drawing import DISCARDED_RGB, KEPT_RGB
from fieldpose.deploy.viewing.moments import Moment
from fieldpose.stages.geometry import Camera, camera_centre, inverse
from fieldpose.stages.nerf.metadata import FieldMetadata
from fieldpose.stages.nerf.surface.samples import ColouredPoints

_COLOURS = {
    TrackingState.TRACKING: (60, 200, 90),
    TrackingState.LIMITED: (240, 170, 40),
}
_NOT_SURE_RGB = (200, 60, 60)
_TRAINING_RGB = (150, 150, 150)
_MOST_VIEWS = 100
_MOST_SEGMENTS = 2000
_SIGMAS = 2.0
"""Of the ellipsoid around the camera: 2 standard deviations along an axis."""
_UPRIGHT = np.cos(np.deg2rad(50.0))
"""An axis of the field within this of what the cameras hold upwards is taken for it."""


class Scene:
    """What a page shows in 3-D of a field, and of moments of a pipeline; all in the field's frame and unit."""

    def __init__(self, server: viser.ViserServer, metadata: FieldMetadata, surface: ColouredPoints) -> None:
        self._scene, self._scale = server.scene, surface.spread
        self._camera: viser.CameraFrustumHandle | None = None
        self._ellipsoid: viser.MeshHandle | None = None
        self._way: viser.LineSegmentsHandle | None = None
        self._points: viser.PointCloudHandle | None = None
        self._lifted: object = None
        up = up_direction(metadata)
        self._scene.set_up_direction(up)
        self._scene.add_frame("/object", axes_length=0.3 * self._scale, axes_radius=0.008 * self._scale)
        self._scene.add_point_cloud(
            "/surface", surface.points.astype(np.float32), surface.colours, point_size=0.6 * surface.spacing,
            point_shape="circle", point_shading="flat",
        )  # fmt: skip
        views = metadata.cameras[:: -(-len(metadata.cameras) // _MOST_VIEWS) or 1]
        self._training = [
            _frustum(self._scene, f"/training/{i}", view.camera, view.pose, 0.04 * self._scale, _TRAINING_RGB)
            for i, view in enumerate(views)
        ]
        if metadata.cameras:
            eye = camera_centre(metadata.cameras[0].pose)
            middle = np.median(surface.points, axis=0) if len(surface.points) else np.zeros(3)
            server.initial_camera.position = tuple(middle + 1.6 * (eye - middle))
            server.initial_camera.look_at = tuple(middle)
            server.initial_camera.up = up

    def show_training(self, visible: bool) -> None:
        """Show the training cameras, or hide them."""
        for frustum in self._training:
            frustum.visible = visible

    def place(self, moment: Moment, picture: np.ndarray | None) -> None:
        """Show where the camera is, with its picture (h, w, 3) uint8, and how sure that is; nothing where unknown."""
        pose, state = moment.pose, moment.state
        known = pose is not None and state is not None and moment.camera is not None
        if self._camera is not None:
            self._camera.visible = known
        if self._ellipsoid is not None:
            self._ellipsoid.visible = known and state is not None and state.covariance is not None
        if pose is None or state is None or moment.camera is None:
            return
        colour = _COLOURS.get(state.state, _NOT_SURE_RGB)
        small = None if picture is None else picture[::4, ::4]
        self._camera = _frustum(self._scene, "/camera", moment.camera, pose, 0.15 * self._scale, colour, image=small)
        if state.covariance is not None:
            vertices, faces = ellipsoid(pose, np.array(state.covariance), _SIGMAS)
            self._ellipsoid = self._scene.add_mesh_simple(
                "/uncertainty", vertices, faces, color=colour, opacity=0.4, side="double", cast_shadow=False
            )

    def draw_way(self, way: Sequence[tuple[np.ndarray, TrackingState]]) -> None:
        """Show where the camera was, as a line; every so-manieth place where there are very many."""
        if len(way) < 2:
            if self._way is not None:
                self._way.remove()
                self._way = None
            return
        some = [*way[:: -(-len(way) // _MOST_SEGMENTS)], way[-1]]
        places = np.array([place for place, _ in some], np.float32)
        colours = np.array([_COLOURS.get(state, _NOT_SURE_RGB) for _, state in some], np.uint8)
        segments = np.stack([places[:-1], places[1:]], axis=1)
        self._way = self._scene.add_line_segments(
            "/way", segments, np.stack([colours[:-1], colours[1:]], axis=1), thickness=2.0, thickness_units="screen"
        )

    def draw_lifted(self, moment: Moment) -> None:
        """Show the points of the newest solve."""
        lifted = moment.lifted
        if lifted is self._lifted:
            return
        self._lifted = lifted
        if self._points is not None:
            self._points.remove()
            self._points = None
        if lifted is not None:
            colours = np.where(lifted.kept[:, None], np.array(KEPT_RGB), np.array(DISCARDED_RGB)).astype(np.uint8)
            self._points = self._scene.add_point_cloud(
                "/lifted", lifted.points_in_object, colours, point_size=0.012 * self._scale, point_shape="circle"
            )


def up_direction(metadata: FieldMetadata) -> tuple[float, float, float]:
    """What training cameras hold upwards on the whole, in the field's frame: an axis of it, where one is near.

    z where there are none, or where they are held in all ways.
    """
    ups = np.array([-view.pose[1, :3] for view in metadata.cameras]).reshape(-1, 3)
    mean = ups.mean(axis=0) if len(ups) else np.zeros(3)
    length = float(np.linalg.norm(mean))
    if length < 0.2:
        return (0.0, 0.0, 1.0)
    axis = np.zeros(3)
    nearest = int(np.abs(mean).argmax())
    axis[nearest] = np.sign(mean[nearest])
    x, y, z = axis if axis @ mean >= _UPRIGHT * length else mean / length
    return (float(x), float(y), float(z))


def ellipsoid(pose: np.ndarray, covariance: np.ndarray, sigmas: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) and triangles (m, 3) around the camera's centre, by a left twist's covariance (6, 6)."""
    rotation = pose[:3, :3]
    # A twist t from the left moves the centre by -R^T t; its rotation is about the camera's centre.
    spread = rotation.T @ covariance[:3, :3] @ rotation
    values, axes = np.linalg.eigh(spread)
    ball, triangles = _sphere()
    vertices = ball * (sigmas * np.sqrt(np.maximum(values, 0))) @ axes.T + camera_centre(pose)
    return vertices.astype(np.float32), triangles


def _sphere(rows: int = 9, columns: int = 16) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) and triangles (m, 3) of a ball of radius 1, by latitude and longitude."""
    down, around = np.linspace(0, np.pi, rows), np.linspace(0, 2 * np.pi, columns, endpoint=False)
    ring = np.stack([np.cos(around), np.sin(around)], axis=1)
    vertices = np.concatenate(
        [np.column_stack([np.sin(a) * ring, np.full(columns, np.cos(a))]) for a in down]
    )  # fmt: skip
    here = np.arange((rows - 1) * columns)
    beside = here // columns * columns + (here + 1) % columns
    quads = np.stack([here, here + columns, beside, beside, here + columns, beside + columns], axis=1)
    return vertices, quads.reshape(-1, 3).astype(np.uint32)


def seen_from(camera: viser.CameraHandle) -> np.ndarray:
    """cam_from_object (4, 4) of the camera that the page is looked at with."""
    object_from_cam = np.eye(4)
    object_from_cam[:3, :3] = Rotation.from_quat(np.asarray(camera.wxyz), scalar_first=True).as_matrix()
    object_from_cam[:3, 3] = camera.position
    return inverse(object_from_cam)


def _frustum(
    scene: viser.SceneApi, name: str, camera: Camera, pose: np.ndarray, scale: float, colour: tuple[int, int, int],
    image: np.ndarray | None = None,
) -> viser.CameraFrustumHandle:  # fmt: skip
    object_from_cam = inverse(pose)
    return scene.add_camera_frustum(
        name, fov=2 * float(np.arctan(camera.height / 2 / camera.fy)), aspect=camera.width / camera.height, scale=scale,
        thickness=1.5, thickness_units="screen", color=colour, image=image, format="jpeg", cast_shadow=False,
        wxyz=_quaternion(object_from_cam[:3, :3]), position=object_from_cam[:3, 3],
    )  # fmt: skip


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    wxyz: np.ndarray = Rotation.from_matrix(rotation).as_quat(scalar_first=True)
    return wxyz
