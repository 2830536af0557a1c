"""The page itself, served by viser: a 3-D scene, the camera's image beside it, and how tracking has been.

viser, since it is one package that serves a page without anything from elsewhere, and draws scene, images and plots.
"""

from __future__ import annotations

import io
import logging
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass

import numpy as np
import viser
from scipy.spatial.transform import Rotation
from viser import uplot

from fieldpose.bus.messages import TrackingState
from fieldpose.deploy.viewing.drawing import DISCARDED_RGB, KEPT_RGB, LEGEND, OVERLAYS, drawn
from fieldpose.deploy.viewing.moments import Moment, told
from fieldpose.errors import TransportError
from fieldpose.stages.geometry import Camera, camera_centre, inverse
from fieldpose.stages.nerf.metadata import FieldMetadata
from fieldpose.stages.nerf.rendering_api import RayRenderer
from fieldpose.stages.nerf.surface.samples import ColouredPoints

_COLOURS = {
    TrackingState.TRACKING: (60, 200, 90),
    TrackingState.LIMITED: (240, 170, 40),
}
_NOT_SURE_RGB = (200, 60, 60)
_TRAINING_RGB = (150, 150, 150)
_MOST_VIEWS = 100
_PLOTTED = 300
_SIGMAS = 2.0
"""Of the ellipsoid around the camera: 2 standard deviations along an axis."""


@dataclass(frozen=True)
class Actions:
    """What buttons do, each giving a line of what came of it; none where nothing is running that could be asked."""

    reset: Callable[[], str] | None = None
    guess: Callable[[np.ndarray], str] | None = None


class Page:
    """Shows moments of one pipeline at http://HOST:PORT. Raises TransportError where nothing can be served there."""

    def __init__(
        self, host: str, port: int, title: str, metadata: FieldMetadata, renderer: RayRenderer | None,
        surface: ColouredPoints, actions: Actions,
    ) -> None:  # fmt: skip
        # Where a browser that is closed ends a connection halfway, it would print a traceback.
        logging.getLogger("websockets").setLevel(logging.CRITICAL)
        with redirect_stdout(io.StringIO()):
            try:
                self._server = viser.ViserServer(host, port, label=title, verbose=False)
            except OSError as error:
                raise TransportError(f"--host {host} --port {port}: nothing can be served there: {error}") from error
        self._renderer, self._scale = renderer, surface.spread
        self._past: deque[tuple[float, float, float]] = deque(maxlen=_PLOTTED)
        self._plotted_at = 0.0
        self._lifted: object = None
        self._drawn_as: tuple[str, bool] | None = None
        self._add_scene(metadata, surface)
        self._add_panel(title, actions)

    @property
    def port(self) -> int:
        """Where it is served: the next free port, where the one asked for was taken."""
        return int(self._server.get_port())

    @property
    def watched(self) -> bool:
        """Whether somebody looks."""
        return bool(self._server.get_clients())

    def close(self) -> None:
        """Serve no more."""
        with redirect_stdout(io.StringIO()):
            self._server.stop()

    def add_timeline(self, frames: int) -> None:
        """A slider over the frames of a recording, and a switch that lets them play."""
        with self._server.gui.add_folder("recording", order=0.5):
            self._slider = self._server.gui.add_slider("frame", 0, max(frames - 1, 1), 1, 0)
            self._playing = self._server.gui.add_checkbox("play", False)
        self._frames = frames

    def chosen(self) -> int:
        """The frame of the timeline to be shown; each time the next, where it plays."""
        at = int(self._slider.value)
        if self._playing.value:
            at = 0 if at >= self._frames - 1 else at + 1
            setattr(self._slider, "value", at)  # noqa: B010 (typed as read-only, which it is not)
        return min(at, self._frames - 1)

    def asked_otherwise(self) -> bool:
        """Whether the image is asked for in another way than it was last drawn."""
        return (self._overlay.value, self._points.value) != self._drawn_as

    def note(self, moments: Sequence[Moment]) -> None:
        """Take in what is plotted of frames: seconds, score, latency in ms."""
        for moment in moments:
            if moment.state is not None:
                latency = moment.latency_ms
                self._past.append((moment.capture_ns / 1e9, moment.state.score, np.nan if latency is None else latency))

    def show(self, moment: Moment, way: Sequence[tuple[np.ndarray, TrackingState]], rate_hz: float | None) -> None:
        """Show a frame: its image, where its camera is, and the way there."""
        self._drawn_as = self._overlay.value, self._points.value
        picture = drawn(moment, self._renderer, self._overlay.value, self._points.value)
        if picture is not None:
            self._image.image = picture
        self._said.content = _said(moment, rate_hz)
        self._place(moment, picture)
        self._draw_way(way)
        self._draw_lifted(moment)
        self._plot()

    def _add_scene(self, metadata: FieldMetadata, surface: ColouredPoints) -> None:
        scene = self._server.scene
        scene.set_up_direction("+z")
        scene.add_frame("/object", axes_length=0.3 * self._scale, axes_radius=0.008 * self._scale)
        scene.add_point_cloud(
            "/surface",
            surface.points.astype(np.float32),
            surface.colours,
            point_size=0.6 * surface.spacing,
            point_shape="circle",
            point_shading="flat",
        )
        views = metadata.cameras[:: -(-len(metadata.cameras) // _MOST_VIEWS) or 1]
        self._training = [
            _frustum(scene, f"/training/{i}", view.camera, view.pose, 0.04 * self._scale, _TRAINING_RGB)
            for i, view in enumerate(views)
        ]
        start = metadata.cameras[0].pose if metadata.cameras else None
        self._camera: viser.CameraFrustumHandle | None = None
        self._ellipsoid: viser.MeshHandle | None = None
        if start is not None:
            eye, middle = (
                camera_centre(start),
                np.median(surface.points, axis=0) if len(surface.points) else np.zeros(3),
            )
            self._server.initial_camera.position = tuple(middle + 1.6 * (eye - middle))
            self._server.initial_camera.look_at = tuple(middle)
            self._server.initial_camera.up = (0.0, 0.0, 1.0)

    def _add_panel(self, title: str, actions: Actions) -> None:
        gui = self._server.gui
        gui.configure_theme(control_layout="fixed", control_width="large", show_logo=False, show_share_button=False)
        self._image = gui.add_image(np.full((120, 160, 3), 40, np.uint8), label=title, format="jpeg", order=0)
        self._said = gui.add_markdown("waiting for a frame", order=0.2)
        with gui.add_folder("image", order=1):
            self._overlay = gui.add_dropdown("field over it", OVERLAYS, initial_value="edges")
            self._points = gui.add_checkbox("points", True)
            gui.add_markdown(_legend())
        with gui.add_folder("scene", order=2):
            training = gui.add_checkbox("training cameras", True)
            training.on_update(lambda _: self._show_training(training.value))
        if actions.reset is not None or actions.guess is not None:
            with gui.add_folder("tracking", order=3):
                self._add_buttons(actions)
        empty = np.zeros(2)
        with gui.add_folder("over time", order=4):
            self._scores = _chart(gui, "score, 0 to 1", (empty, empty), "#18a558", (0.0, 1.0))
            self._latencies = _chart(gui, "latency, ms", (empty, empty), "#1f7ae0", None)

    def _add_buttons(self, actions: Actions) -> None:
        gui = self._server.gui
        answer = None
        if actions.reset is not None:
            reset = actions.reset
            button = gui.add_button("begin again", hint="forget what is believed, and look for the camera anew")
            button.on_click(lambda _: self._answer(reset()))
        if actions.guess is not None:
            guess = actions.guess
            button = gui.add_button("the camera is about here", hint="turn the scene as the camera sees it, then click")

            def here(event: viser.GuiEvent[viser.GuiButtonHandle]) -> None:
                if event.client is not None:
                    self._answer(guess(_seen_from(event.client.camera)))

            button.on_click(here)
        self._answered = gui.add_markdown(answer or "")

    def _answer(self, line: str) -> None:
        self._answered.content = line

    def _show_training(self, visible: bool) -> None:
        for frustum in self._training:
            frustum.visible = visible

    def _place(self, moment: Moment, picture: np.ndarray | None) -> None:
        pose, state = moment.pose, moment.state
        if pose is None or state is None or moment.camera is None:
            if self._camera is not None:
                self._camera.visible = False
            if self._ellipsoid is not None:
                self._ellipsoid.visible = False
            return
        colour = _COLOURS.get(state.state, _NOT_SURE_RGB)
        small = None if picture is None else picture[::4, ::4]
        self._camera = _frustum(
            self._server.scene, "/camera", moment.camera, pose, 0.15 * self._scale, colour, image=small
        )
        if state.covariance is not None:
            vertices, faces = ellipsoid(pose, np.array(state.covariance), _SIGMAS)
            self._ellipsoid = self._server.scene.add_mesh_simple(
                "/uncertainty", vertices, faces, color=colour, opacity=0.4, side="double", cast_shadow=False
            )

    def _draw_way(self, way: Sequence[tuple[np.ndarray, TrackingState]]) -> None:
        if len(way) < 2:
            return
        places = np.array([place for place, _ in way], np.float32)
        colours = np.array([_COLOURS.get(state, _NOT_SURE_RGB) for _, state in way], np.uint8)
        segments = np.stack([places[:-1], places[1:]], axis=1)
        self._server.scene.add_line_segments(
            "/way", segments, np.stack([colours[:-1], colours[1:]], axis=1), thickness=2.0, thickness_units="screen"
        )

    def _draw_lifted(self, moment: Moment) -> None:
        lifted = moment.lifted
        if lifted is None or lifted is self._lifted:
            return
        self._lifted = lifted
        colours = np.where(lifted.kept[:, None], np.array(KEPT_RGB), np.array(DISCARDED_RGB)).astype(np.uint8)
        self._server.scene.add_point_cloud(
            "/lifted", lifted.points_in_object, colours, point_size=0.012 * self._scale, point_shape="circle"
        )

    def _plot(self) -> None:
        now = time.monotonic()
        if now - self._plotted_at < 1.0 or len(self._past) < 2:
            return
        self._plotted_at = now
        seconds, scores, latencies = np.array(self._past).T
        order = np.argsort(seconds, kind="stable")
        since = seconds[order] - seconds.max()
        self._scores.data = (since, scores[order])
        self._latencies.data = (since, np.nan_to_num(latencies[order]))


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


def _seen_from(camera: viser.CameraHandle) -> np.ndarray:
    """cam_from_object (4, 4) of the camera that the page is looked at with."""
    object_from_cam = np.eye(4)
    object_from_cam[:3, :3] = Rotation.from_quat(np.asarray(camera.wxyz), scalar_first=True).as_matrix()
    object_from_cam[:3, 3] = camera.position
    return inverse(object_from_cam)


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    wxyz: np.ndarray = Rotation.from_matrix(rotation).as_quat(scalar_first=True)
    return wxyz


def _said(moment: Moment, rate_hz: float | None) -> str:
    state, rows = moment.state, [f"**{told(moment)}**"]
    if state is not None:
        numbers = [f"score {state.score:.2f}"]
        if moment.latency_ms is not None:
            numbers.append(f"latency {moment.latency_ms:.0f} ms")
        if rate_hz is not None:
            numbers.append(f"{rate_hz:.0f} frames/s")
        numbers.append(f"{state.dropped_at_the_door} dropped")
        numbers.append(f"{state.lost} lost")
        rows.append(", ".join(numbers))
    rows.append(f"frame {moment.frame_id}")
    return "\n\n".join(rows)


def _legend() -> str:
    return "<br>".join(f'<span style="color:rgb{colour}">&#9679;</span> {what}' for what, colour in LEGEND.items())


def _chart(
    gui: viser.GuiApi, title: str, data: tuple[np.ndarray, np.ndarray], colour: str, limits: tuple[float, float] | None
) -> viser.GuiUplotHandle:  # fmt: skip
    scales = {"x": uplot.Scale(time=False)} | ({} if limits is None else {"y": uplot.Scale(range=limits)})
    series = (uplot.Series(label="seconds ago"), uplot.Series(label=title, stroke=colour, width=1.5))
    return gui.add_uplot(data, series, title=title, scales=scales, aspect=2.6)
