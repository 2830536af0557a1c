"""A page on which a pipeline is seen at work."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from fieldpose.bus.ports import Inbox
from fieldpose.bus.replay import info
from fieldpose.bus.signals import StopSignals
from fieldpose.bus.topics import FRAME, STATE, Address
from fieldpose.bus.transport import LOCAL_HUB
from fieldpose.connection import Connection
from fieldpose.deploy.access.joining import Entry, joined
from fieldpose.deploy.access.roles import OPERATOR, VIEWER
from fieldpose.deploy.reporting.provenance import pipelines_in, recorded_field
from fieldpose.deploy.viewing.moments import WATCHED, Moment, Moments
from fieldpose.deploy.viewing.recorded import RecordedMoments
from fieldpose.errors import FieldposeError, UsageError
from fieldpose.stages.nerf.field import Field, load_field
from fieldpose.stages.nerf.loading import make_renderer
from fieldpose.stages.nerf.surface.samples import sampled_surface

if TYPE_CHECKING:
    from fieldpose.deploy.viewing.page import Actions, Page

_HUB_S, _ASK_S = 60.0, 3.0
_PICTURES_HZ = 10.0
_RATE_S = 3.0
_NICE = 10
"""Lower than what tracks: the page is what waits, where there are too few cores."""
_QUEUED, _IMAGES = 512, 8


@dataclass(frozen=True)
class Options:
    """Serve a page that shows a running pipeline, or a recording: the camera's image with the field over it, the scene
    with the camera's way, and how tracking has been.

    Example: fieldpose view out/lego.safetensors

    Open the address that it prints in a browser of this machine; with --host 0.0.0.0 in one of another, a phone's for
    instance, which then everybody in that network can do. Nothing is drawn while nobody looks, and at most ten pictures
    a second; the process runs at a low priority. A recording is given in place of the field, and has a slider.
    """

    what: tyro.conf.Positional[Path]
    """The field (.safetensors) of the pipeline that is running, or a recording (.mcap)."""
    connect: str = LOCAL_HUB
    """Where the hub of the pipeline is; `fieldpose run` says it when it starts."""
    host: str = "127.0.0.1"
    """Who may open the page: 127.0.0.1 is this machine alone, 0.0.0.0 everybody who reaches it."""
    port: int = 8080
    """Of the page; the next free one is taken where somebody has it already."""
    field: Path | None = None
    """The field of a recording, where it does not hold its own."""
    pipeline: str | None = None
    """OBJECT/CAMERA: which pipeline of a recording, where it holds several."""
    seconds: float | None = None
    """Stop after this time."""
    entry: Annotated[Entry, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Entry)
    address: Annotated[Address, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Address)
    """Which pipeline."""

    def run(self) -> int:
        """Serve until Ctrl-C."""
        if not 1 <= self.port <= 65535:
            raise UsageError(f"--port {self.port}: expected 1 to 65535")
        os.nice(_NICE)
        return self._recording() if self.what.suffix == ".mcap" else self._live()

    def _recording(self) -> int:
        recording = info(self.what)
        with TemporaryDirectory(prefix="fieldpose-") as folder:
            pipeline = self.pipeline if pipelines_in(recording) else None
            path = self.field or recorded_field(self.what, recording, Path(folder), pipeline)
            field = load_field(path)
            moments = RecordedMoments(self.what, self.pipeline)
            page = self._page(field, f"{self.what.name}")
            page.add_timeline(len(moments))
            page.note(moments.all)
            self._say(page)
            shown = -1

            def update() -> None:
                nonlocal shown
                if not page.watched:
                    return
                chosen = page.chosen()
                if chosen != shown or page.asked_otherwise():
                    shown = chosen
                    page.show(moments.at(shown), moments.way(shown), None)

            return self._serve(page, update)

    def _live(self) -> int:
        field = load_field(self.what)
        with joined(self.connect, self.entry, (OPERATOR, VIEWER), _HUB_S) as bus:
            inbox = Inbox(
                bus, self.address, WATCHED, {topic: _IMAGES if topic is FRAME else _QUEUED for topic in WATCHED}
            )
            page = self._page(field, self.address.pair, self._actions())
            self._say(page)
            return self._serve(page, _Live(inbox, page).update)

    def _page(self, field: Field, title: str, actions: Actions | None = None) -> Page:
        # It brings what serves pages, which takes a while.
        from fieldpose.deploy.viewing.page import Actions, Page

        renderer = make_renderer(field, 1)
        surface = sampled_surface(renderer, field.metadata)
        return Page(self.host, self.port, title, field.metadata, renderer, surface, actions or Actions())

    def _actions(self) -> Actions:
        from fieldpose.deploy.viewing.page import Actions

        def asked(do: Callable[[Connection], object]) -> str:
            try:
                with Connection(self.connect, self.address, _ASK_S, self.entry, (OPERATOR, VIEWER)) as pipeline:
                    do(pipeline)
            except FieldposeError as error:
                return f"not done: {error}"
            return "done"

        def reset() -> str:
            return asked(lambda pipeline: pipeline.reset(timeout_s=_ASK_S))

        def guess(cam_from_object: np.ndarray) -> str:
            return asked(lambda pipeline: pipeline.reset(cam_from_object, _ASK_S))

        return Actions(reset, guess)

    def _say(self, page: Page) -> None:
        shown = "127.0.0.1" if self.host == "0.0.0.0" else self.host
        print(f"http://{shown}:{page.port} shows it; Ctrl-C ends this", flush=True)

    def _serve(self, page: Page, update: Callable[[], None]) -> int:
        end = None if self.seconds is None else time.monotonic() + self.seconds
        try:
            with StopSignals() as signals:
                while not signals.stop.wait(1 / _PICTURES_HZ) and (end is None or time.monotonic() < end):
                    update()
        finally:
            page.close()
        return 0


class _Live:
    """Passes on what a running pipeline says, where somebody looks."""

    def __init__(self, inbox: Inbox, page: Page) -> None:
        self._inbox, self._page = inbox, page
        self._moments = Moments()
        self._shown: tuple[int, int] | None = None
        self._noted = 0
        self._came: list[float] = []

    def update(self) -> None:
        for received in self._inbox.drain():
            self._moments.note(received.message)
            if received.topic is STATE:
                self._came.append(time.monotonic())
        now = time.monotonic()
        self._came = [at for at in self._came if at > now - _RATE_S]
        self._page.note(self._new())
        newest = self._moments.newest()
        if newest is None or not self._page.watched:
            return
        key = newest.frame_id, newest.capture_ns
        if key != self._shown:
            self._shown = key
            self._page.show(newest, self._moments.way, len(self._came) / _RATE_S)

    def _new(self) -> Sequence[Moment]:
        fresh = [moment for moment in self._moments.answered() if moment.capture_ns > self._noted]
        self._noted = max((moment.capture_ns for moment in fresh), default=self._noted)
        return fresh
