"""The embedded scene through the whole pipeline."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro
from rich.progress import Progress

from fieldpose.bus.reading import info
from fieldpose.deploy.access.joining import NO_ENTRY
from fieldpose.deploy.commands.run import INTERRUPTED, check_recorded, draw, planned
from fieldpose.deploy.processes.pipeline import Run, run_pipelines
from fieldpose.deploy.reporting.output import check_writable, progress_console, write_bytes, write_json
from fieldpose.deploy.reporting.provenance import RUN_RECORD
from fieldpose.deploy.reporting.report import live_line, print_summary
from fieldpose.deploy.reporting.results import RunResult, summarise
from fieldpose.deploy.scene import demo_file
from fieldpose.deploy.settings import Settings
from fieldpose.deploy.viewing.beside import page_beside
from fieldpose.errors import RecordingError


@dataclass(frozen=True)
class Options:
    """Run a recorded camera sequence through the whole pipeline, with the field that is shipped with it.

    Example: fieldpose demo --out out/demo

    It plays at the camera's own 30 frames a second; what the pipeline cannot keep up with is dropped at the door.
    Writes into the folder: summary.json (keys as of `fieldpose run`), recording.mcap, timeline.png (errors, scores,
    latencies and states over time), and overlay.jpg and overlay.mp4: the field rendered at the poses found, over the
    camera's images.
    """

    out: Path = Path("out/demo")
    """The folder to write into."""
    json: Path | None = None
    """Write the figures into this file too."""
    view: bool = False
    """Serve a page that shows the run while it lasts, and print its address; see `fieldpose view`."""
    video: bool = True
    """Write overlay.jpg and overlay.mp4."""
    logs: Path | None = None
    """Keep the logs of the processes in this folder."""
    config: Path | None = None
    """TOML or JSON file of settings; flags win over it."""
    settings: Annotated[Settings, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Settings)

    def run(self) -> int:
        """Run, print the tables, write the files."""
        field, sequence = demo_file("field.safetensors"), demo_file("sequence.mcap")
        recording = self.out / "recording.mcap"
        check_writable(recording, self.json)
        camera = replace(self.settings.camera, source=f"mcap:{sequence}")
        _remove_earlier(recording, sequence.name)
        plan = planned(replace(self.settings, camera=camera), field)
        with page_beside((plan,), None, self.view, NO_ENTRY) as hub, live_line("demo") as report:
            (outcome,) = run_pipelines(Run((plan,), recording, hub, self.logs), report)
        written = [recording, self.out / "summary.json"]
        summary = summarise(outcome)
        print_summary(summary, "demo")
        write_json(written[-1], summary)
        write_json(self.json, summary)
        if outcome.interrupted:
            return INTERRUPTED
        written.append(self.out / "timeline.png")
        draw(outcome, plan, written[-1], "demo")
        check_recorded(outcome)
        if self.video:
            written += self._show(outcome, field, recording)
        print(f"written: {', '.join(map(str, written))}")
        return 0

    def _show(self, outcome: RunResult, field: Path, recording: Path) -> list[Path]:
        """Write the picture and the video; returns those that there are, none without any frame that was answered."""
        from fieldpose.deploy.reporting.overlay import encoded
        from fieldpose.deploy.reporting.showing import pictures, write_video
        from fieldpose.stages.nerf.loading import load_renderer

        video, still = self.out / "overlay.mp4", self.out / "overlay.jpg"
        renderer = load_renderer(field, threads=0, backend=self.settings.backend)
        with _bar("rendering the video") as report:
            best = write_video(video, pictures(recording, outcome.frames, renderer, report))
        if best is None:
            return []
        write_bytes(still, encoded(best.pixels, still))
        return [still, video]


def _remove_earlier(recording: Path, sequence: str) -> None:
    """Make room where an earlier demo has left its recording; another one is never touched."""
    if not recording.exists():
        return
    if not info(recording).metadata.get(RUN_RECORD, {}).get("source", "").endswith(f"/{sequence}"):
        raise RecordingError(f"{recording}: is there already, and is no recording of a demo; give another --out")
    recording.unlink()


@contextmanager
def _bar(title: str) -> Iterator[Callable[[int, int], None]]:
    console = progress_console()
    with Progress(console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(title, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)
