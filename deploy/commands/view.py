"""A page on which a pipeline is seen at work."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from socket import AF_INET
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

import psutil
import tyro

from fieldpose.bus.reading import RecordingInfo, info
from fieldpose.bus.signals import StopSignals
from fieldpose.bus.topics import Address
from fieldpose.bus.transport import LOCAL_HUB
from fieldpose.deploy.access.joining import Entry, joined
from fieldpose.deploy.access.roles import OPERATOR, VIEWER
from fieldpose.deploy.reporting.provenance import pipelines_in, recorded_field
from fieldpose.deploy.viewing.asking import Actions, actions_on
from fieldpose.deploy.viewing.recorded import RecordedMoments
from fieldpose.errors import RecordingError, UsageError
from fieldpose.stages.nerf.field import Field, load_field, load_metadata
from fieldpose.stages.nerf.loading import make_renderer
from fieldpose.stages.nerf.surface.samples import sampled_surface

if TYPE_CHECKING:
    from fieldpose.deploy.viewing.page import Page

_HUB_S = 60.0
_PICTURES_HZ = 10.0
_NICE = 10
"""Lower than what tracks: the page is what waits, where there are too few cores."""
_THIS_MACHINE = ("127.0.0.1", "localhost")


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
        if self.what.name.endswith((".mcap.partial", ".mcap.partial.before")):
            whole = self.what.with_name(self.what.name.removesuffix(".before").removesuffix(".partial"))
            raise UsageError(f"{self.what}: unfinished; `fieldpose recover {self.what} --out {whole}` mends it")
        return self._recording() if self.what.suffix == ".mcap" else self._live()

    def _recording(self) -> int:
        recording = info(self.what)
        with TemporaryDirectory(prefix="fieldpose-") as folder:
            pipeline = self.pipeline if pipelines_in(recording) else None
            path = self._field_of(recording, Path(folder), pipeline)
            moments = RecordedMoments(self.what, self.pipeline)
            page = self._page(load_field(path), self.what.name)
            page.add_timeline(len(moments), moments.after)
            page.plot(moments.history)
            self._say(page)
            shown, way_of = -1, -1

            def update() -> None:
                nonlocal shown, way_of
                if not page.watched:
                    return
                chosen = page.chosen()
                if chosen != shown or page.asked_otherwise():
                    shown = chosen
                    page.show(moments.at(shown), moments.way(shown), None)
                elif way_of != shown:
                    way_of = shown
                    page.draw_way(moments.way(shown))

            return self._serve(page, update)

    def _field_of(self, recording: RecordingInfo, folder: Path, pipeline: str | None) -> Path:
        """Raises UsageError where another field is asked for than the recorded poses are of, in another frame."""
        if self.field is None:
            return recorded_field(self.what, recording, folder, pipeline)
        try:
            recorded = load_metadata(recorded_field(self.what, recording, folder, pipeline)).frame
        except RecordingError:
            return self.field
        if load_metadata(self.field).frame != recorded:
            raise UsageError(
                f"--field {self.field}: its frame is another than that of the recorded poses (see `fieldpose frame`);"
                " view the recording without --field, or replay it with this field and view that"
            )
        return self.field

    def _live(self) -> int:
        field = load_field(self.what)
        with joined(self.connect, self.entry, (OPERATOR, VIEWER), _HUB_S) as bus:
            page = self._page(field, self.address.pair, actions_on(bus, self.address))
            self._say(page)
            # It brings what serves pages, which takes a while.
            from fieldpose.deploy.viewing.live import Live

            live = Live(bus, self.address, page)
            try:
                return self._serve(page, live.update)
            finally:
                live.close()

    def _page(self, field: Field, title: str, actions: Actions | None = None) -> Page:
        from fieldpose.deploy.viewing.page import Page

        os.nice(_NICE)
        renderer = make_renderer(field, 1)
        surface = sampled_surface(renderer, field.metadata)
        return Page(self.host, self.port, title, field.metadata, renderer, surface, actions)

    def _say(self, page: Page) -> None:
        print(f"http://127.0.0.1:{page.port} shows it; Ctrl-C ends this", flush=True)
        if self.host not in _THIS_MACHINE:
            hosts = own_addresses() if self.host == "0.0.0.0" else [self.host]
            others = ", ".join(f"http://{host}:{page.port}" for host in hosts)
            print(f"from other machines, a phone for instance: {others or 'this machine has no address'}", flush=True)

    def _serve(self, page: Page, update: Callable[[], None]) -> int:
        end = None if self.seconds is None else time.monotonic() + self.seconds
        try:
            with StopSignals() as signals:
                while not signals.stop.wait(1 / _PICTURES_HZ) and (end is None or time.monotonic() < end):
                    update()
        finally:
            page.close()
        return 0


def own_addresses() -> list[str]:
    """IPv4 addresses under which other machines may reach this one."""
    found = (address for addresses in psutil.net_if_addrs().values() for address in addresses)
    return sorted(each.address for each in found if each.family == AF_INET and not each.address.startswith("127."))
