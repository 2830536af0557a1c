"""The page itself, served by viser: a 3-D scene, the camera's image beside it, and how tracking has been.

viser, since it is one package that serves a page without anything from elsewhere, and draws scene, images and plots.
"""

from __future__ import annotations

import io
import logging
import time
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from html import escape

import numpy as np
import viser

from fieldpose.bus.messages import TrackingState
from fieldpose.deploy.viewing.asking import NO_RECORDER, Actions
from fieldpose.deploy.viewing.charts import Charts
from fieldpose.deploy.viewing.drawing import LEGEND, OVERLAYS, drawn
from fieldpose.deploy.viewing.history import History
from fieldpose.deploy.viewing.moments import Moment, told
from fieldpose.deploy.viewing.scene import Scene, seen_from
from fieldpose.errors import TransportError
from fieldpose.stages.nerf.metadata import FieldMetadata
from fieldpose.stages.nerf.rendering_api import RayRenderer
from fieldpose.stages.nerf.surface.samples import ColouredPoints

_WAY_S = 1.0
"""The way is long: it is drawn anew no more often."""
_STYLE = (
    # viser's sheet on a phone is 20em wide, whatever the phone is.
    "<style>@media (max-width:36em){[style*='width: 20em']{width:100%!important}}"
    ".fieldpose{padding:0 .5em;font-size:.875em;line-height:1.45;overflow-wrap:anywhere}.fieldpose p{margin:.2em 0}"
    ".fieldpose .soft{opacity:.7}</style>"
)


class Page:
    """Shows moments of one pipeline at http://HOST:PORT. Raises TransportError where nothing can be served there.

    actions: what can be asked of it; None where nothing is running that could be asked.
    """

    def __init__(
        self, host: str, port: int, title: str, metadata: FieldMetadata, renderer: RayRenderer | None,
        surface: ColouredPoints, actions: Actions | None = None,
    ) -> None:  # fmt: skip
        # Where a browser that is closed ends a connection halfway, it would print a traceback.
        logging.getLogger("websockets").setLevel(logging.CRITICAL)
        with redirect_stdout(io.StringIO()):
            try:
                self._server = viser.ViserServer(host, port, label=title, verbose=False)
            except OSError as error:
                raise TransportError(f"--host {host} --port {port}: nothing can be served there: {error}") from error
        self._renderer, self._actions = renderer, actions
        self._drawn_as: tuple[str, bool] | None = None
        self._way_drawn_at = 0.0
        self._scene = Scene(self._server, metadata, surface)
        self._add_panel()
        self._charts = Charts(self._server.gui, ago=actions is not None)

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

    def add_timeline(self, frames: int, after: Callable[[int, float], int]) -> None:
        """A slider over the frames of a recording, and a switch that lets them play.

        after: the frame that comes so many seconds after another.
        """
        with self._server.gui.add_folder("recording", order=1):
            self._slider = self._server.gui.add_slider("frame", 0, max(frames - 1, 1), 1, 0)
            self._playing = self._server.gui.add_checkbox("play", False)
        self._frames, self._after, self._chosen_at = frames, after, time.monotonic()

    def chosen(self) -> int:
        """The frame of the timeline to be shown; where it plays, what comes as long after the last as has passed."""
        at, now = min(int(self._slider.value), self._frames - 1), time.monotonic()
        passed_s, self._chosen_at = now - self._chosen_at, now
        if self._playing.value:
            at = self._after(at, passed_s)
            setattr(self._slider, "value", at)  # noqa: B010 (typed as read-only, which it is not)
        return at

    def asked_otherwise(self) -> bool:
        """Whether the image is asked for in another way than it was last drawn."""
        return (self._overlay.value, self._points.value) != self._drawn_as

    def show(
        self, moment: Moment, way: Sequence[tuple[np.ndarray, TrackingState]], rate_hz: float | None
    ) -> None:  # fmt: skip
        """Show a frame: its image, where its camera is, and the way there. rate_hz: frames answered a second."""
        self._drawn_as = self._overlay.value, self._points.value
        picture = drawn(moment, self._renderer, self._overlay.value, self._points.value)
        if picture is not None:
            self._image.image = picture
        self._image.visible = picture is not None
        self.tell(moment, rate_hz, None)
        self._scene.place(moment, picture)
        self._scene.draw_lifted(moment)
        now = time.monotonic()
        if now - self._way_drawn_at >= _WAY_S or len(way) < 2:
            self._way_drawn_at = now
            self._scene.draw_way(way)

    def draw_way(self, way: Sequence[tuple[np.ndarray, TrackingState]]) -> None:
        """Draw the way of a frame on which the page stays."""
        self._scene.draw_way(way)

    def tell(self, moment: Moment, rate_hz: float | None, silent_s: float | None) -> None:
        """Say what became of a frame, and for how long nothing has come, where that is long."""
        self._say(*_said(moment, rate_hz), bad=None if silent_s is None else f"Nothing has come for {silent_s:.0f} s.")

    def say(self, line: str) -> None:
        """Say something in place of a frame's state."""
        self._say(line)

    def plot(self, history: History) -> None:
        """Draw what is known over time."""
        self._charts.draw(history)

    def look_for_recorder(self) -> None:
        """Offer to save what came last where a recorder is there, and say what is missing where not."""
        if self._actions is not None:
            there = self._actions.can_save()
            self._save.disabled = not there
            self._no_recorder.visible = not there

    def _add_panel(self) -> None:
        gui = self._server.gui
        gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        self._said = gui.add_html("", order=0)
        self._say("waiting for a frame")
        self._image = gui.add_image(np.zeros((3, 4, 3), np.uint8), format="jpeg", order=0.5, visible=False)
        if self._actions is not None:
            with gui.add_folder("tracking", order=2):
                self._add_buttons(self._actions)
        with gui.add_folder("image", order=3):
            self._overlay = gui.add_dropdown("field over it", OVERLAYS, initial_value="edges")
            self._points = gui.add_checkbox("points", True)
            gui.add_html(_legend())
        with gui.add_folder("scene", order=5):
            training = gui.add_checkbox("training cameras", True)
            training.on_update(lambda _: self._scene.show_training(training.value))

    def _add_buttons(self, actions: Actions) -> None:
        gui = self._server.gui

        def button(
            label: str, hint: str, do: Callable[[viser.GuiEvent[viser.GuiButtonHandle]], str]
        ) -> viser.GuiButtonHandle:
            handle = gui.add_button(label, hint=hint)

            def clicked(event: viser.GuiEvent[viser.GuiButtonHandle]) -> None:
                self._answer("asking …")
                self._answer(do(event))

            handle.on_click(clicked)
            return handle

        button("begin again", "forget what is believed, and look for the camera anew", lambda _: actions.reset())
        button("the camera is about here", "turn the scene as the camera sees it, then click",
               lambda event: "" if event.client is None else actions.guess(seen_from(event.client.camera)))  # fmt: skip
        button("take a keyframe", "solve the next frame, and keep its view for following if that fits",
               lambda _: actions.keyframe())  # fmt: skip
        self._save = button("save the last 10 s", "have the recorder write what came last", lambda _: actions.save())
        self._no_recorder = gui.add_html(_html(NO_RECORDER, soft=True))
        self._answered = gui.add_html("")

    def _answer(self, line: str) -> None:
        self._answered.content = _html(line)

    def _say(self, *lines: str, bad: str | None = None) -> None:
        first, *others = lines
        warned = "" if bad is None else f'<p style="color:#c0392b"><b>{escape(bad)}</b></p>'
        rest = "".join(f"<p>{escape(line)}</p>" for line in others)
        self._said.content = f'{_STYLE}<div class="fieldpose">{warned}<p><b>{escape(first)}</b></p>{rest}</div>'


def _said(moment: Moment, rate_hz: float | None) -> list[str]:
    state, numbers = moment.state, [f"frame {moment.frame_id}"]
    if state is not None:
        numbers.append(f"score {state.score:.2f}")
        if moment.latency_ms is not None:
            numbers.append(f"latency {moment.latency_ms:.0f} ms")
        if rate_hz is not None:
            numbers.append(f"{rate_hz:.0f} frames/s")
        numbers.append(f"{state.dropped_at_the_door} dropped, {state.lost} lost so far")
    return [told(moment), ", ".join(numbers)]


def _html(line: str, soft: bool = False) -> str:
    return f'<div class="fieldpose"><p{" class=soft" if soft else ""}>{escape(line)}</p></div>' if line else ""


def _legend() -> str:
    each = (f'<span style="color:rgb{colour}">&#9679;</span> {escape(what)}' for what, colour in LEGEND.items())
    return f'<div class="fieldpose"><p>{"<br>".join(each)}</p></div>'
